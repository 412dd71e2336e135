"""Scenes turned and shifted together with what is done in them."""

from __future__ import annotations

import math

import torch as th
from stable_baselines3.common.type_aliases import TensorDict
from torch.nn import functional as F

from sb3_extensions.common.exploration import EXPLORED_HEIGHT
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.spatial_dqn.codec import PIXEL, SpatialActionCodec

# Standard deviation of a shift, in sides of the image (the authors' code).
SHIFT = 1 / 20
# Motions drawn for a sample, of which the first that keeps everything in view is taken; none if there is
# none.
TRIES = 20
ROUNDING = 1e-3  # pixels: a turn by a right angle keeps what reaches the border in view


class RigidMotion:
    """
    A random rigid motion for each sample: heightmaps turn by a multiple of the angle between two yaws of the
    grid, where actions have a yaw, and shift by a normal error; pixels and yaws move with them. The in-hand
    image, which turns with the gripper, stays.

    A motion is drawn again until all that is higher than one centimetre stays in view, and the pixel too.

    :param codec: the grid
    :param image_key: of the heightmap in an observation
    """

    def __init__(self, codec: SpatialActionCodec, image_key: str) -> None:
        self.codec, self.image_key = codec, image_key
        self.names = [*PIXEL, *codec.grids]

    def __call__(
        self, samples: ExpertReplayBufferSamples, indices: th.Tensor, generator: th.Generator
    ) -> tuple[ExpertReplayBufferSamples, th.Tensor]:
        """
        Move samples; their ``actions`` stay as they were.

        :param samples: as the replay buffer gave them
        :param indices: of their actions, int64 (batch, indices)
        :param generator: source of the randomness, on the CPU
        :return: samples with moved heightmaps, moved indices
        """
        observations, next_observations = samples.observations, samples.next_observations
        assert isinstance(observations, dict) and isinstance(next_observations, dict)
        turns, shifts = self._draw(observations, next_observations, indices, generator)
        moved = samples._replace(
            observations=self._moved(observations, turns, shifts),
            next_observations=self._moved(next_observations, turns, shifts),
        )
        return moved, self._moved_indices(indices, turns, shifts)

    @property
    def rotations(self) -> int:
        """Number of yaws, over half a turn; 0 where actions have none and heightmaps do not turn."""
        return len(self.codec.grids.get("theta", []))

    def _draw(
        self, before: TensorDict, after: TensorDict, indices: th.Tensor, generator: th.Generator
    ) -> tuple[th.Tensor, th.Tensor]:
        """Turns in steps between two yaws, (batch,), and shifts in pixels, (batch, 2)."""
        size, count = self.codec.size, len(indices)
        turns = th.randint(max(1, 2 * self.rotations), (count, TRIES), generator=generator)
        shifts = th.randn(count, TRIES, 2, generator=generator) * (SHIFT * size)
        device = indices.device
        turns, shifts = turns.to(device), shifts.round().to(device)
        points = th.cat(
            [_corners(before[self.image_key]), _corners(after[self.image_key]), indices[:, None, :2]], 1
        )
        moved = self._turned(points[:, None].expand(-1, TRIES, -1, -1), turns[..., None]) + shifts[:, :, None]
        fits = ((moved > -ROUNDING) & (moved < size - 1 + ROUNDING)).all(dim=3).all(dim=2)
        first, rows = fits.int().argmax(dim=1), th.arange(count, device=device)
        possible = fits.any(dim=1)
        return turns[rows, first] * possible, shifts[rows, first] * possible[:, None]

    def _turned(self, points: th.Tensor, turns: th.Tensor) -> th.Tensor:
        """Rows and columns (..., 2) about the middle of the image, turned; float32."""
        middle = (self.codec.size - 1) / 2.0
        angle = self._angle(turns)
        row, column = (points - middle).unbind(-1)
        cos, sin = angle.cos(), angle.sin()
        return th.stack([cos * row - sin * column, sin * row + cos * column], dim=-1) + middle

    def _angle(self, turns: th.Tensor) -> th.Tensor:
        return turns * (math.pi / max(1, self.rotations))

    def _moved(self, observations: TensorDict, turns: th.Tensor, shifts: th.Tensor) -> TensorDict:
        """Heightmaps as they would be after the motion, the nearest pixel's height; 0 beyond the border."""
        image, size = observations[self.image_key], self.codec.size
        line = th.arange(size, device=image.device) - (size - 1) / 2.0
        angle = self._angle(turns)[:, None, None]
        cos, sin = angle.cos(), angle.sin()
        # Where each pixel was, from the middle: turned back, after shifting back
        row, column = line[:, None] - shifts[:, 0, None, None], line - shifts[:, 1, None, None]
        before = th.stack([cos * column - sin * row, cos * row + sin * column], dim=-1) * (2.0 / size)
        return {
            **observations,
            self.image_key: F.grid_sample(image, before, mode="nearest", align_corners=False),
        }

    def _moved_indices(self, indices: th.Tensor, turns: th.Tensor, shifts: th.Tensor) -> th.Tensor:
        moved = indices.clone()
        pixels = self._turned(indices[:, None, :2], turns[:, None])[:, 0] + shifts
        moved[:, :2] = pixels.round().long().clamp(0, self.codec.size - 1)
        if self.rotations:
            theta = self.names.index("theta")
            yaw = indices[:, theta] + turns
            moved[:, theta] = yaw % self.rotations
            flipped = (yaw // self.rotations) % 2 == 1
            for name in ("phi", "psi"):
                if name in self.names:
                    place, count = self.names.index(name), len(self.codec.grids[name])
                    moved[:, place] = th.where(flipped, count - 1 - indices[:, place], indices[:, place])
        return moved


def _corners(images: th.Tensor) -> th.Tensor:
    """Corners of what stands out of the floor, rows and columns (batch, 4, 2); the middle where nothing
    does.
    """
    stands = images[:, 0] > EXPLORED_HEIGHT
    ends = []
    for axis in (1, 2):
        line = stands.any(dim=3 - axis)
        first, last = line.int().argmax(dim=1), line.shape[1] - 1 - line.flip(1).int().argmax(dim=1)
        empty = ~line.any(dim=1)
        middle = line.shape[1] // 2
        ends.append([end.masked_fill(empty, middle) for end in (first, last)])
    return th.stack([th.stack([row, column], dim=1) for row in ends[0] for column in ends[1]], dim=1)
