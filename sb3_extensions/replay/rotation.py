"""Rotation of images and actions of a sampled step by one angle, and augmentations by name."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.common.components import check_fraction, make_components
from sb3_extensions.common.observations import KEY, as_parts
from sb3_extensions.replay.augmentation import RAD, Augmentation, Compose, DrQ, scene_keys, scene_side
from sb3_extensions.replay.samples import ExpertReplayBufferSamples

N_CANDIDATES = 8
"""Number of angles sampled for each step. The first that keeps the actions within their bounds is used."""
TOLERANCE = 1e-6
"""Excess over the bounds of an action that float32 rounding can cause."""


def rotate_images(images: th.Tensor, angles: th.Tensor) -> th.Tensor:
    """
    Rotate images about their centres. Pixels outside have the value of the nearest border pixel.

    Interpolation is bilinear. Integer images of one channel can hold labels and use the nearest pixel.

    :param images: shape (batch, channels, size, size), rows along x and columns along y
    :param angles: from x towards y, rad, shape (batch,); pi / 2 is ``numpy.rot90(image, k=1)``
    :return: rotated images of the same shape and type
    """
    size, is_label = images.shape[-1], images.shape[1] == 1 and not images.is_floating_point()
    line = (th.arange(size, device=images.device) * 2 + 1) / size - 1
    cos, sin = angles.cos()[:, None, None].float(), angles.sin()[:, None, None].float()
    row, column = line[:, None], line
    # Source of each pixel, in the order of grid_sample: column, row
    grid = th.stack([cos * column - sin * row, sin * column + cos * row], dim=-1)
    mode = "nearest" if is_label else "bilinear"
    rotated = F.grid_sample(images.float(), grid, mode, padding_mode="border", align_corners=False)
    return rotated if images.is_floating_point() else rotated.round().to(images.dtype)


def rotate_actions(actions: th.Tensor, angles: th.Tensor, action_sequence: ActionSequence) -> th.Tensor:
    """Rotate (dx, dy) of actions, and the x and y components of rotation vectors, by angles (rad)."""
    rotated = actions.clone()
    cos, sin = angles.cos().to(actions.dtype), angles.sin().to(actions.dtype)
    for pair in ("xy", "uv"):
        if columns := action_sequence.indices(pair):
            x, y = actions[..., columns[0]], actions[..., columns[1]]
            rotated[..., columns[0]] = cos * x - sin * y
            rotated[..., columns[1]] = sin * x + cos * y
    return rotated


@dataclass(frozen=True)
class Rotation(Augmentation):
    """
    Rotate both observations, the action and the expert's action of a step by one random angle.

    Only the images of the largest size rotate. The r of an action must be a rotation relative to the gripper
    (closed loop). Angles are uniform in [0, 2 pi) among those for which the rotated actions are within
    [-1, 1]. If none of :data:`N_CANDIDATES` sampled angles is, a random multiple of pi / 2 is used. To save
    time, the next observation is rotated only if the target bootstraps from it.

    Source: https://arxiv.org/abs/2205.14292, "Equi SACfD + PER + Aug", which stores four rotated copies of
    each step.

    :param probability: probability of a rotation; 0.8 is the share of four copies next to the original step
    :param action_sequence: see :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :raises ValueError: if an argument is out of its range
    """

    probability: float = 0.8
    action_sequence: str = "pxyzr"

    def __post_init__(self) -> None:
        check_fraction(probability=self.probability)
        sequence = ActionSequence(self.action_sequence, len(self.action_sequence))
        if "x" not in sequence:
            raise ValueError(f"action_sequence must have x and y to rotate, got {self.action_sequence!r}")

    def check(self, space: spaces.Space[object], has_absolute_yaw: bool = False) -> None:
        """Check that there are square images to rotate, and that the r of actions stays the same."""
        scene_side(space)
        if has_absolute_yaw:
            raise ValueError(f"augmentation must not rotate open-loop actions with a yaw, got {self}")

    def __call__(
        self, samples: ExpertReplayBufferSamples, generator: th.Generator
    ) -> ExpertReplayBufferSamples:
        """Return the rotated sample."""
        sequence = ActionSequence(self.action_sequence, samples.actions.shape[1])
        angles = self._sample_angles(samples.actions, samples.expert_actions, sequence, generator)
        before, after = as_parts(samples.observations), as_parts(samples.next_observations)
        rows = (samples.dones[:, 0] == 0).nonzero()[:, 0]
        for key in scene_keys(before):
            before[key] = rotate_images(before[key], angles)
            after[key] = after[key].index_copy(0, rows, rotate_images(after[key][rows], angles[rows]))
        is_image = isinstance(samples.observations, th.Tensor)
        return samples._replace(
            observations=before[KEY] if is_image else before,
            next_observations=after[KEY] if is_image else after,
            actions=rotate_actions(samples.actions, angles, sequence).clamp(-1, 1),
            expert_actions=rotate_actions(samples.expert_actions, angles, sequence).clamp(-1, 1),
        )

    def _sample_angles(
        self, actions: th.Tensor, expert_actions: th.Tensor, sequence: ActionSequence, generator: th.Generator
    ) -> th.Tensor:
        """Return angles that keep all rotated actions within their bounds, (batch,)."""
        n = len(actions)
        candidates = th.rand(n, N_CANDIDATES, generator=generator) * (2 * math.pi)
        quarters = th.randint(4, (n,), generator=generator) * (math.pi / 2)
        unchanged = th.rand(n, generator=generator) >= self.probability
        candidates = th.cat([candidates, quarters[:, None]], dim=1).to(actions.device)
        valid = th.ones_like(candidates, dtype=th.bool)
        for original in (actions, expert_actions):
            rotated = rotate_actions(original[:, None].expand(-1, N_CANDIDATES + 1, -1), candidates, sequence)
            moved = [column for pair in ("xy", "uv") for column in sequence.indices(pair)]
            # NaN, an unknown action, is valid.
            valid &= ~(rotated[..., moved].abs() > 1 + TOLERANCE).any(dim=2)
        valid[:, -1] = True
        first = valid.int().argmax(dim=1, keepdim=True)
        return candidates.gather(1, first)[:, 0].masked_fill(unchanged.to(actions.device), 0.0)


AugmentationSpec = Augmentation | str | Mapping[str, Mapping[str, Any] | None] | None


def make_augmentation(spec: AugmentationSpec, action_sequence: str | None = None) -> Augmentation | None:
    """
    Create an augmentation from its specification.

    :param spec: an augmentation, None, a name (``"drq"``), or names with their arguments
        (``{"rotation": {}, "rad": {"size": 64}}``), of which a rotation is applied first
    :param action_sequence: default ``action_sequence`` of a rotation
    :raises ValueError: if the specification is something else
    """
    if isinstance(spec, Augmentation):
        return spec
    rotation = partial(Rotation, action_sequence=action_sequence) if action_sequence else Rotation
    steps = make_components("augmentation", spec, {"rotation": rotation, "rad": RAD, "drq": DrQ})
    return Compose(tuple(steps)) if len(steps) > 1 else next(iter(steps), None)
