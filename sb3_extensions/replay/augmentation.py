"""Augmentation of sampled steps: the base class, random crops (RAD) and random shifts (DrQ)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from inspect import signature
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TensorDict

from sb3_extensions.common.components import check_integer
from sb3_extensions.common.observations import as_parts, scene_images, space_parts
from sb3_extensions.replay.samples import ExpertReplayBufferSamples

Observations = TensorDict | th.Tensor


class Augmentation(ABC):
    """Random transformation of sampled steps."""

    @abstractmethod
    def __call__(
        self, samples: ExpertReplayBufferSamples, generator: th.Generator
    ) -> ExpertReplayBufferSamples:
        """
        Return an augmented sample. Several views of each observation make the sample longer.

        :param samples: sample of the replay buffer
        :param generator: random generator on the CPU
        """

    def check(self, space: spaces.Space[Any], has_absolute_yaw: bool = False) -> None:  # noqa: B027
        """
        Raise a ValueError if samples cannot be augmented.

        :param space: space of the observations
        :param has_absolute_yaw: whether actions have a yaw in the world
        """

    @property
    def window(self) -> RandomWindow | None:
        """Augmentation with random windows, None without one."""
        return None

    def with_crop(self, policy_kwargs: dict[str, Any]) -> dict[str, Any]:
        """
        Return arguments of a policy whose features extractor crops images to the size of the views.

        :raises ValueError: if ``features_extractor_class`` has no parameter ``crop``
        """
        if self.window is None or self.window.size is None:
            return policy_kwargs
        if extractor := policy_kwargs.get("features_extractor_class"):
            try:
                signature(extractor).bind_partial(crop=self.window.size)
            except TypeError as error:
                message = f"features_extractor_class must have a parameter crop for {self}, got {extractor}"
                raise ValueError(message) from error
        extractor_kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
        return {
            **policy_kwargs,
            "features_extractor_kwargs": {**extractor_kwargs, "crop": self.window.size},
        }


@dataclass(frozen=True)
class Compose(Augmentation):
    """
    Apply several augmentations in order.

    :param steps: the augmentations; at most one with random windows, and :class:`DrQ` last
    :raises ValueError: if there are several with random windows, or another one follows DrQ
    """

    steps: tuple[Augmentation, ...]

    def __post_init__(self) -> None:
        windows = [step for step in self.steps if step.window is not None]
        if len(windows) > 1 or any(isinstance(step, DrQ) for step in self.steps[:-1]):
            raise ValueError(f"augmentation must have at most one of RAD and DrQ, DrQ last, got {self.steps}")

    def __call__(
        self, samples: ExpertReplayBufferSamples, generator: th.Generator
    ) -> ExpertReplayBufferSamples:
        """Return the augmented sample."""
        for step in self.steps:
            samples = step(samples, generator)
        return samples

    def check(self, space: spaces.Space[Any], has_absolute_yaw: bool = False) -> None:
        """Check all augmentations."""
        for step in self.steps:
            step.check(space, has_absolute_yaw)

    @property
    def window(self) -> RandomWindow | None:
        """The augmentation with random windows."""
        return next((step.window for step in self.steps if step.window is not None), None)


class RandomWindow(Augmentation):
    """
    Random windows of images whose border pixels are repeated ``pad`` times outwards.

    All images of the largest size, which show the scene, get the same window. Smaller images do not change.
    """

    pad: int = 0
    size: int | None = None
    """Side of a window in pixels, None for the side of the images."""

    @property
    def window(self) -> RandomWindow:
        """This augmentation."""
        return self

    def check(self, space: spaces.Space[Any], has_absolute_yaw: bool = False) -> None:
        """Check that there are images larger than a window."""
        side = scene_side(space)
        if self.size is not None and side <= self.size:
            raise ValueError(
                f"observation_space must have images larger than {self.size} x {self.size} pixels for "
                f"{self}, got {space}"
            )

    def average_targets(self, values: th.Tensor) -> th.Tensor:
        """Return means over the views of each next observation, one row for each view of an observation."""
        return values

    def view(self, observations: Observations, generator: th.Generator, copies: int = 1) -> Observations:
        """Return ``copies`` independent windows of each observation, first axis ``copies * batch``."""
        return self._cut(observations, self._offsets(observations, generator, copies))

    def _offsets(self, observations: Observations, generator: th.Generator, copies: int = 1) -> th.Tensor:
        """Return uniform positions of the windows (row, column) in the padded images, (copies * batch, 2)."""
        parts = as_parts(observations)
        image = parts[scene_keys(parts)[0]]
        positions = image.shape[-1] + 2 * self.pad - (self.size or image.shape[-1]) + 1
        offsets = th.randint(positions, (copies * len(image), 2), generator=generator)
        return offsets.to(image.device)

    def _cut(self, observations: Observations, offsets: th.Tensor) -> Observations:
        if isinstance(observations, th.Tensor):
            return self._cut_image(observations, offsets)
        cut = scene_keys(observations)
        return {
            key: self._cut_image(part, offsets) if key in cut else repeat(part, len(offsets) // len(part))
            for key, part in observations.items()
        }

    def _cut_image(self, images: th.Tensor, offsets: th.Tensor) -> th.Tensor:
        size = self.size or images.shape[-1]
        if self.pad:
            border = th.arange(-self.pad, images.shape[-1] + self.pad, device=images.device)
            border = border.clamp_(0, images.shape[-1] - 1)
            images = images.index_select(-2, border).index_select(-1, border)
        # A view of all windows: (batch, channels, row, column, size, size)
        windows = images.unfold(-2, size, 1).unfold(-2, size, 1)
        sample = th.arange(len(offsets), device=images.device) % len(images)
        return windows[sample, :, offsets[:, 0], offsets[:, 1]]


@dataclass(frozen=True)
class RAD(RandomWindow):
    """
    Random crops, the same for both observations of a step. A policy acts on the centre of an image.

    Source: https://arxiv.org/abs/2004.14990; 142 x 142 pixels are cropped to 128 (BulletArm, appendix
    "Benchmark Details").

    :param size: side of the crop in pixels; the images must be larger
    :raises ValueError: if the size is not positive
    """

    size: int = 128

    def __post_init__(self) -> None:
        check_integer(1, size=self.size)

    def __call__(
        self, samples: ExpertReplayBufferSamples, generator: th.Generator
    ) -> ExpertReplayBufferSamples:
        """Return the sample with cropped observations."""
        offsets = self._offsets(samples.observations, generator)
        return samples._replace(
            observations=self._cut(samples.observations, offsets),
            next_observations=self._cut(samples.next_observations, offsets),
        )


@dataclass(frozen=True)
class DrQ(RandomWindow):
    """
    Random shifts by up to ``pad`` pixels.

    The target is the mean over ``K`` views of the next observation. The losses of critic and actor are means
    over ``M`` views of the observation.

    Source: https://arxiv.org/abs/2004.13649; K = M = 2 (BulletArm, the authors' code).

    :param K: number of views of a next observation
    :param M: number of views of an observation
    :param pad: maximum shift along an axis in pixels
    :raises ValueError: if an argument is not positive
    """

    K: int = 2
    M: int = 2
    pad: int = 4

    def __post_init__(self) -> None:
        check_integer(1, K=self.K, M=self.M, pad=self.pad)

    def __call__(
        self, samples: ExpertReplayBufferSamples, generator: th.Generator
    ) -> ExpertReplayBufferSamples:
        """Return M views of the observations and K of the next observations."""
        columns: dict[str, Any] = samples._asdict()
        observations, next_observations = columns.pop("observations"), columns.pop("next_observations")
        columns |= {key: repeat(part, self.M) for key, part in columns.items() if isinstance(part, th.Tensor)}
        return ExpertReplayBufferSamples(
            observations=self.view(observations, generator, self.M),
            next_observations=self.view(next_observations, generator, self.K),
            **columns,
        )

    def average_targets(self, values: th.Tensor) -> th.Tensor:
        """Return the mean over the K views, repeated for the M views; shape (M * batch, n)."""
        return repeat(values.view(self.K, -1, values.shape[1]).mean(dim=0), self.M)


def repeat(values: th.Tensor, copies: int) -> th.Tensor:
    """Return ``copies`` of a batch, one after the other, first axis ``copies * batch``."""
    return values if copies == 1 else values.repeat(copies, *[1] * (values.dim() - 1))


def scene_keys(parts: TensorDict) -> list[str]:
    """Return the keys of the images of the scene in a batch."""
    return scene_images({key: part.shape[1:] for key, part in parts.items()})


def scene_side(space: spaces.Space[Any]) -> int:
    """
    Return the side (pixels) of the images of the scene in an observation space.

    :raises ValueError: if there are none, or one is not square
    """
    shapes = {key: part.shape or () for key, part in space_parts(space).items()}
    sides = {side for key in scene_images(shapes) for side in shapes[key][1:]}
    if len(sides) != 1:
        raise ValueError(f"observation_space must have images (channels, size, size), got {space}")
    return sides.pop()
