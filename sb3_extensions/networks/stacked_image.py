"""The images and numbers of an observation as one image of many channels, for a convolutional encoder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_extensions.common.images import IMAGE_AXES, scene_images
from sb3_extensions.networks.points import point_clouds
from sb3_extensions.replay.quantisation import Quantiser

# Name of the only image where an observation is no Dict.
IMAGE_KEY = "image"


class StackedImage(nn.Module):
    """One image of a Dict observation: the images' channels, and a constant channel for each other number.

    An observation that is an image already is taken as the only one. Of images of several sizes the largest
    are taken; :class:`~sb3_extensions.networks.extractors.SmallImages` are the others, and point clouds,
    (n, 3).

    Float images (such as heights in metres) are mapped from the bounds of their space to [0, 1], rounded to
    the levels that the replay buffer stores; ``uint8`` images arrive so from Stable-Baselines3 (its
    ``normalize_images`` must stay on). Numbers, and unrounded images without finite bounds, are taken as they
    are.

    :param observation_space: with at least one image, (channels, size, size)
    :param quantise: ``"uint8"`` or ``"uint16"``: what the replay buffer stores float images as; ``None`` if
        it stores floats
    :param crop: side, in pixels, of the part that is taken from the centre of larger images; images of this
        size, as cut out at random in training, are taken whole. ``None`` takes all images whole
    :param standardise: (mean, standard deviation) in the images' units (of ``uint8`` images: [0, 1]): they
        become (image - mean) / standard deviation instead of [0, 1]. What differs little within the bounds,
        as heights of a few centimetres, is then learnt in far fewer updates. ``uint8`` images beside float
        ones, as colours beside heights, stay in [0, 1]
    :param above_ground: (mean, standard deviation) of the ground's distance from the camera, in the images'
        units. Float images, distances from a camera that looks down, are turned into heights above the
        farthest point that each shows: the scene then looks the same wherever the camera is, and the zeros
        beyond the border are ground. The distance of that point becomes a constant channel, standardised.
        ``standardise`` is of the heights then
    :raises ValueError: if the space has no image or images of other shapes, their bounds cannot be
        quantised, the largest are smaller than the crop, ``standardise`` or ``above_ground`` is something
        else, or the images are ``uint8`` and ``above_ground`` is given
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        quantise: str | None,
        crop: int | None = None,
        standardise: Sequence[float] | None = None,
        above_ground: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        parts = {IMAGE_KEY: observation_space}
        if isinstance(observation_space, spaces.Dict):
            parts = observation_space.spaces
        all_images = square_images(parts)
        images = largest_images(all_images)
        side = int(next(iter(images.values())).shape[1])
        if crop is not None and not 1 <= crop <= side:
            raise ValueError(f"crop must be from 1 to the images' size, {side}, got {crop}")
        self.size = crop or side
        self.quantise = quantise
        self.has_float_images = not all(is_image_space(space) for space in images.values())
        if above_ground is not None and not self.has_float_images:
            raise ValueError(f"above_ground must be None for uint8 images, got {above_ground}")
        self.scales = {
            # Colours beside heights are no heights
            key: _Scale(key, space, quantise)
            if self.has_float_images and is_image_space(space)
            else _Scale(key, space, quantise, standardise, above_ground)
            for key, space in images.items()
        }
        others = all_images.keys() | point_clouds(parts).keys()
        numbers = {key: space for key, space in parts.items() if key not in others}
        self.number_keys = list(numbers)
        self.channels = sum(scale.channels for scale in self.scales.values())
        self.channels += sum(get_flattened_obs_dim(space) for space in numbers.values())

    @property
    def image_keys(self) -> set[str]:
        """Keys of the images."""
        return set(self.scales)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, channels, size, size)"""
        if isinstance(observations, th.Tensor):
            observations = {IMAGE_KEY: observations}
        parts = [
            part
            for key, scale in self.scales.items()
            for part in scale(crop_centre(observations[key], self.size))
        ]
        parts += [observations[key].flatten(1)[..., None, None] for key in self.number_keys]
        return th.cat([part.expand(-1, -1, self.size, self.size) for part in parts], dim=1)


def square_images(parts: Mapping[str, gym.Space[Any]]) -> dict[str, spaces.Box]:
    """
    Spaces of the images of an observation.

    :param parts: space of each part of it
    :return: the images', in the order of the parts
    :raises ValueError: if there is none, or one that is not (channels, size, size)
    """
    images = {
        key: space
        for key, space in parts.items()
        if isinstance(space, spaces.Box) and len(space.shape) == IMAGE_AXES
    }
    if not images or any(space.shape[1] != space.shape[2] for space in images.values()):
        shapes = {key: space.shape or space for key, space in parts.items()}
        advice = (
            ""
            if images
            else ". Use neither FlattenObservation nor FrameStackObservation for images, "
            "and a StatePolicy or the MlpExtractor for numbers alone."
        )
        raise ValueError(
            f"observation_space must have images, all (channels, size, size), got {shapes}{advice}"
        )
    return images


def largest_images(images: Mapping[str, spaces.Box]) -> dict[str, spaces.Box]:
    """Spaces of the images of the largest size, of some images, in their order."""
    return {key: images[key] for key in scene_images({key: space.shape for key, space in images.items()})}


def crop_centre(images: th.Tensor, size: int) -> th.Tensor:
    """
    The middle of images; where it cannot be exact, half a pixel up and to the left.

    :param images: last axes (side, side)
    :param size: side of the middle, pixels
    :return: last axes (size, size); the images themselves if they have this size
    """
    start = (images.shape[-1] - size) // 2
    return images[..., start : start + size, start : start + size]


class _Scale:
    """Maps an image to [0, 1], or standardises it, or the heights that it shows.

    :param key: of the observation, for the error
    :param space: of the image
    :param quantise: see :class:`StackedImage`
    :param standardise: see :class:`StackedImage`
    :param above_ground: see :class:`StackedImage`
    :raises ValueError: if the space cannot be quantised so, or ``standardise`` or ``above_ground`` is
        something else
    """

    def __init__(
        self,
        key: str,
        space: spaces.Box,
        quantise: str | None,
        standardise: Sequence[float] | None = None,
        above_ground: Sequence[float] | None = None,
    ) -> None:
        for name, value in {"standardise": standardise, "above_ground": above_ground}.items():
            if value is not None and not (len(value) == 2 and value[1] > 0.0):
                raise ValueError(f"{name} must be (mean, standard deviation above 0), got {value}")
        self.standardise, self.above_ground = standardise, above_ground
        self.channels = int(space.shape[0]) * (1 if above_ground is None else 2)
        self.quantiser: Quantiser | None = None
        self.low, self.span = 0.0, 1.0
        if is_image_space(space):
            return
        if quantise is not None:
            try:
                self.quantiser = Quantiser(space, quantise)
            except ValueError as error:
                raise ValueError(
                    f"quantise={quantise!r} does not fit observation {key!r}: {error}"
                ) from error
        low, high = float(space.low.min()), float(space.high.max())
        if math.isfinite(high - low) and high > low:
            self.low, self.span = low, high - low

    def __call__(self, image: th.Tensor) -> tuple[th.Tensor, ...]:
        """:return: (batch, channels, size, size), of constant channels (batch, channels, 1, 1)"""
        if self.above_ground is not None:
            return self._heights(self._rounded(image), *self.above_ground)
        if self.standardise is not None:
            mean, std = self.standardise
            return ((self._rounded(image) - mean) / std,)
        if self.quantiser is not None:
            return (self.quantiser.normalise(image),)
        return ((image - self.low) / self.span,)

    def _heights(self, distances: th.Tensor, mean: float, std: float) -> tuple[th.Tensor, th.Tensor]:
        """Heights above the farthest point of each image, then how far it is."""
        farthest = distances.amax(dim=(-2, -1), keepdim=True)
        lowest, unit = self.standardise or (0.0, self.span)
        return (farthest - distances - lowest) / unit, (farthest - mean) / std

    def _rounded(self, image: th.Tensor) -> th.Tensor:
        return image if self.quantiser is None else self.quantiser.round_trip(image)
