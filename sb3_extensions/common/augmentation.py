"""Random views of the images in a sample, and how an update uses them: RAD and DrQ."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TensorDict

from sb3_extensions.common.images import scene_images
from sb3_extensions.replay.samples import FrameReplayBufferSamples

Observations = TensorDict | th.Tensor


class Augmentation(ABC):
    """Random views of image observations, and which of them an update takes.

    A view is a window on an image whose edge pixels are repeated ``pad`` times outwards. All images of the
    largest size, which show the scene, are cut alike; everything else in an observation stays as it is, also
    smaller images, such as what was where the gripper closed.
    """

    pad: int = 0
    size: int | None = None  # side of a view, pixels; None: that of the images

    @abstractmethod
    def __call__(
        self, samples: FrameReplayBufferSamples, generator: th.Generator
    ) -> FrameReplayBufferSamples:
        """
        Replace the observations of a sample by views; more than one of each makes the sample longer.

        :param samples: as the replay buffer gave them
        :param generator: source of the randomness, on the CPU
        :return: the augmented sample
        """

    def average_targets(self, values: th.Tensor) -> th.Tensor:
        """
        From values of the augmented next observations to values for the augmented observations.

        :param values: (views of the next observations, number of values)
        :return: (views of the observations, number of values), the mean over the views of each next
            observation
        """
        return values

    def check(self, space: spaces.Space[Any]) -> None:
        """
        Check that there are images to cut.

        :param space: of the observations
        :raises ValueError: if it has no images, or its largest ones are too small
        """
        parts = space.spaces if isinstance(space, spaces.Dict) else {"image": space}
        shapes = {key: part.shape or () for key, part in parts.items()}
        sides = [shapes[key][-1] for key in scene_images(shapes)]
        if not sides or (self.size is not None and min(sides) <= self.size):
            larger = "" if self.size is None else f" larger than {self.size} x {self.size} pixels"
            raise ValueError(f"augmentation={self} needs images{larger}, got observations {space}")

    def with_crop(self, policy_kwargs: dict[str, Any]) -> dict[str, Any]:
        """
        Parameters of a policy whose networks take views and, when it acts, the centre of the images.

        :param policy_kwargs: parameters of the policy
        :return: a copy in which the features extractor crops, if the views are smaller than the images
        """
        if self.size is None:
            return policy_kwargs
        extractor_kwargs = {**(policy_kwargs.get("features_extractor_kwargs") or {}), "crop": self.size}
        return {**policy_kwargs, "features_extractor_kwargs": extractor_kwargs}

    def view(self, observations: Observations, generator: th.Generator, copies: int = 1) -> Observations:
        """
        Independent random views of each observation.

        :param observations: batch
        :param generator: source of the randomness, on the CPU
        :param copies: number of views of each
        :return: one view of the whole batch after the other, first axis ``copies * batch``
        """
        return self._cut(observations, self._draw(observations, generator, copies))

    def _draw(self, observations: Observations, generator: th.Generator, copies: int = 1) -> th.Tensor:
        """Places of the windows in the padded images (row, column), uniform, (copies * batch, 2)."""
        image = _scene(observations)[0]
        places = image.shape[-1] + 2 * self.pad - (self.size or image.shape[-1]) + 1
        offsets = th.randint(places, (copies * len(image), 2), generator=generator)
        return offsets.to(image.device)

    def _cut(self, observations: Observations, offsets: th.Tensor) -> Observations:
        """The windows at given places, of the batch as often as there are places."""
        if isinstance(observations, th.Tensor):
            return self._cut_image(observations, offsets)
        copies = len(offsets) // len(next(iter(observations.values())))
        cut = scene_images(_shapes(observations))
        return {
            key: self._cut_image(part, offsets) if key in cut else repeat(part, copies)
            for key, part in observations.items()
        }

    def _cut_image(self, images: th.Tensor, offsets: th.Tensor) -> th.Tensor:
        size = self.size or images.shape[-1]
        if self.pad:
            edge = th.arange(-self.pad, images.shape[-1] + self.pad, device=images.device)
            edge = edge.clamp_(0, images.shape[-1] - 1)
            images = images.index_select(-2, edge).index_select(-1, edge)
        windows = images.unfold(-2, size, 1).unfold(
            -2, size, 1
        )  # a view: (batch, channels, places, places, ...)
        sample = th.arange(len(offsets), device=images.device) % len(images)
        return windows[sample, :, offsets[:, 0], offsets[:, 1]]


@dataclass(frozen=True)
class RAD(Augmentation):
    """
    Random crops: the same for both observations of a transition; the networks act on the centre of an image.

    Paper: https://arxiv.org/abs/2004.14990; here 142 x 142 pixels are cropped to 128 (BulletArm, appendix
    "Benchmark Details").

    :param size: side of the crop, pixels; the environment's images must be larger
    :raises ValueError: if the size is not positive
    """

    size: int = 128

    def __post_init__(self) -> None:
        _check_positive(size=self.size)

    def __call__(
        self, samples: FrameReplayBufferSamples, generator: th.Generator
    ) -> FrameReplayBufferSamples:
        """:return: the sample with cropped observations"""
        offsets = self._draw(samples.observations, generator)
        return samples._replace(
            observations=self._cut(samples.observations, offsets),
            next_observations=self._cut(samples.next_observations, offsets),
        )


@dataclass(frozen=True)
class DrQ(Augmentation):
    """
    Random shifts by up to ``pad`` pixels: the target is the mean over ``K`` views of the next observation,
    the losses of critic and actor are means over ``M`` views of the observation.

    Paper: https://arxiv.org/abs/2004.13649; K = M = 2 as BulletArm has it.

    :param K: views of a next observation
    :param M: views of an observation
    :param pad: largest shift along an axis, pixels
    :raises ValueError: if one of them is not positive
    """

    K: int = 2
    M: int = 2
    pad: int = 4

    def __post_init__(self) -> None:
        _check_positive(K=self.K, M=self.M, pad=self.pad)

    def __call__(
        self, samples: FrameReplayBufferSamples, generator: th.Generator
    ) -> FrameReplayBufferSamples:
        """:return: M views of the observations, everything else repeated for them, K of the next ones"""
        fields = samples._asdict()
        repeated: dict[str, Any] = {
            key: repeat(fields[key], self.M) for key in PER_OBSERVATION if fields[key] is not None
        }
        return samples._replace(
            observations=self.view(samples.observations, generator, self.M),
            next_observations=self.view(samples.next_observations, generator, self.K),
            **repeated,
        )

    def average_targets(self, values: th.Tensor) -> th.Tensor:
        """:return: (M * batch, number of values), the mean over K views"""
        return repeat(values.view(self.K, -1, values.shape[1]).mean(dim=0), self.M)


AUGMENTATIONS: dict[str, type[Augmentation]] = {"rad": RAD, "drq": DrQ}
# Entries of a sample that belong to its observations, besides these.
PER_OBSERVATION = (
    "actions",
    "dones",
    "rewards",
    "discounts",
    "returns",
    "expert_actions",
    "is_expert",
    "weights",
)

AugmentationSpec = Augmentation | str | Mapping[str, Mapping[str, Any]] | None


def make_augmentation(spec: AugmentationSpec) -> Augmentation | None:
    """
    An augmentation from what a user or a YAML file may write.

    :param spec: an augmentation, None, a name (``"drq"``), or one with its parameters
        (``{"rad": {"size": 64}}``)
    :return: the augmentation
    :raises ValueError: if it is something else
    """
    if spec is None or isinstance(spec, Augmentation):
        return spec
    named = {spec: None} if isinstance(spec, str) else spec
    if not isinstance(named, Mapping) or len(named) != 1 or not named.keys() <= AUGMENTATIONS.keys():
        raise ValueError(
            "augmentation must be None, an Augmentation, a name or {name: parameters}, the name one of "
            f"{', '.join(AUGMENTATIONS)}, got {spec!r}"
        )
    [(name, parameters)] = named.items()
    try:
        return AUGMENTATIONS[name](**(parameters or {}))
    except TypeError as error:
        raise ValueError(f"augmentation={spec!r}: {error}") from error


def repeat(values: th.Tensor, copies: int) -> th.Tensor:
    """
    A batch several times, one copy after the other.

    :param values: any shape
    :param copies: how often
    :return: first axis ``copies`` times as long
    """
    return values if copies == 1 else values.repeat(copies, *[1] * (values.dim() - 1))


def _scene(observations: Observations) -> list[th.Tensor]:
    """The images that are cut."""
    if isinstance(observations, th.Tensor):
        return [observations]
    return [observations[key] for key in scene_images(_shapes(observations))]


def _shapes(observations: TensorDict) -> dict[str, th.Size]:
    return {key: part.shape[1:] for key, part in observations.items()}


def _check_positive(**values: Any) -> None:
    for name, value in values.items():
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} must be a positive integer, got {value!r}")
