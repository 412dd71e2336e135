"""Augmentation by random rigid motions of scenes and actions."""

import math

import torch as th
from stable_baselines3.common.type_aliases import TensorDict
from torch.nn import functional as F

from sb3_extensions.replay.augmentation import Augmentation
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.spatial_dqn.codec import EXPLORED_HEIGHT, PIXEL, SpatialActionCodec

SHIFT = 1 / 20
"""Standard deviation of a shift as a fraction of the side of the image (the authors' code)."""
N_CANDIDATES = 20
"""Number of sampled motions for each step. The first valid one is used, or none."""
TOLERANCE = 1e-3
"""Tolerance (pixels) of the border, so that a rotation by 90 degrees keeps pixels at the border valid."""


class RigidMotion(Augmentation):
    """
    Random rotation and shift of each sampled step.

    Heightmaps rotate by a multiple of the difference of two yaws of the grid (if actions have a yaw) and
    shift by a normal error. Pixels and yaws of the actions move with them, the in-hand image does not. A
    motion is valid if the pixel and everything higher than one centimetre stay in the image.

    :param codec: conversion of the actions to the grid
    :param image_key: name of the heightmap
    """

    def __init__(self, codec: SpatialActionCodec, image_key: str) -> None:
        self.codec, self.image_key = codec, image_key
        self.names = [*PIXEL, *codec.grids]
        self.rotations = len(codec.grids.get("theta", []))
        """Number of yaws in a range of pi; 0 if actions have no yaw and heightmaps do not rotate."""

    def __call__(
        self, samples: ExpertReplayBufferSamples, generator: th.Generator
    ) -> ExpertReplayBufferSamples:
        """Return samples with moved heightmaps and actions; ``expert_actions`` do not change."""
        before, after = samples.observations, samples.next_observations
        assert isinstance(before, dict) and isinstance(after, dict)
        actions = samples.actions.cpu().numpy()
        indices = th.as_tensor(self.codec.encode(actions), device=samples.actions.device)
        steps, shifts = self._sample_motions(before, after, indices, generator)
        moved_indices = self._move_indices(indices, steps, shifts).cpu().numpy()
        moved_actions = self.codec.decode(moved_indices, self.codec.places(actions))
        return samples._replace(
            observations=self._move_heightmap(before, steps, shifts),
            next_observations=self._move_heightmap(after, steps, shifts),
            actions=th.as_tensor(moved_actions, device=samples.actions.device),
        )

    def _sample_motions(
        self, before: TensorDict, after: TensorDict, indices: th.Tensor, generator: th.Generator
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return rotations in steps of the grid of yaws, (batch,), and shifts in pixels, (batch, 2)."""
        size, count = self.codec.size, len(indices)
        steps = th.randint(max(1, 2 * self.rotations), (count, N_CANDIDATES), generator=generator)
        shifts = th.randn(count, N_CANDIDATES, 2, generator=generator) * (SHIFT * size)
        device = indices.device
        steps, shifts = steps.to(device), shifts.round().to(device)
        points = th.cat(
            [_corners(before[self.image_key]), _corners(after[self.image_key]), indices[:, None, :2]], 1
        )
        rotated = self._rotate(points[:, None].expand(-1, N_CANDIDATES, -1, -1), steps[..., None])
        moved = rotated + shifts[:, :, None]
        valid = ((moved > -TOLERANCE) & (moved < size - 1 + TOLERANCE)).all(dim=3).all(dim=2)
        first, rows = valid.int().argmax(dim=1), th.arange(count, device=device)
        any_valid = valid.any(dim=1)
        return steps[rows, first] * any_valid, shifts[rows, first] * any_valid[:, None]

    def _rotate(self, points: th.Tensor, steps: th.Tensor) -> th.Tensor:
        """Rotate rows and columns (..., 2) about the centre of the image; float32."""
        centre = (self.codec.size - 1) / 2.0
        angle = self._angle(steps)
        row, column = (points - centre).unbind(-1)
        cos, sin = angle.cos(), angle.sin()
        return th.stack([cos * row - sin * column, sin * row + cos * column], dim=-1) + centre

    def _angle(self, steps: th.Tensor) -> th.Tensor:
        return steps * (math.pi / max(1, self.rotations))

    def _move_heightmap(self, observations: TensorDict, steps: th.Tensor, shifts: th.Tensor) -> TensorDict:
        """Move heightmaps by nearest-neighbour interpolation, with 0 outside the image."""
        image, size = observations[self.image_key], self.codec.size
        line = th.arange(size, device=image.device) - (size - 1) / 2.0
        angle = self._angle(steps)[:, None, None]
        cos, sin = angle.cos(), angle.sin()
        # Source of each pixel: the inverse shift, then the inverse rotation.
        row, column = line[:, None] - shifts[:, 0, None, None], line - shifts[:, 1, None, None]
        source = th.stack([cos * column - sin * row, cos * row + sin * column], dim=-1) * (2.0 / size)
        moved = F.grid_sample(image, source, mode="nearest", align_corners=False)
        return {**observations, self.image_key: moved}

    def _move_indices(self, indices: th.Tensor, steps: th.Tensor, shifts: th.Tensor) -> th.Tensor:
        moved = indices.clone()
        pixels = self._rotate(indices[:, None, :2], steps[:, None])[:, 0] + shifts
        moved[:, :2] = pixels.round().long().clamp(0, self.codec.size - 1)
        if self.rotations:
            theta = self.names.index("theta")
            yaw = indices[:, theta] + steps
            moved[:, theta] = yaw % self.rotations
            flipped = (yaw // self.rotations) % 2 == 1
            for name in ("phi", "psi"):
                if name in self.names:
                    column, count = self.names.index(name), len(self.codec.grids[name])
                    moved[:, column] = th.where(flipped, count - 1 - indices[:, column], indices[:, column])
        return moved


def _corners(images: th.Tensor) -> th.Tensor:
    """Return the bounding box of everything above the ground, rows and columns (batch, 4, 2).

    The corners are at the centre of an empty image.
    """
    above_ground = images[:, 0] > EXPLORED_HEIGHT
    ends = []
    for axis in (1, 2):
        line = above_ground.any(dim=3 - axis)
        first, last = line.int().argmax(dim=1), line.shape[1] - 1 - line.flip(1).int().argmax(dim=1)
        empty = ~line.any(dim=1)
        centre = line.shape[1] // 2
        ends.append([end.masked_fill(empty, centre) for end in (first, last)])
    return th.stack([th.stack([row, column], dim=1) for row in ends[0] for column in ends[1]], dim=1)
