"""Inputs of the networks: the images and numbers of an observation as one image, or as a view of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict
from torch import nn

from sb3_extensions.common.images import IMAGE_AXES, scene_images
from sb3_extensions.encoders.points import point_clouds
from sb3_extensions.replay.quantisation import Quantiser

HOLDS = 0.5
"""Above it ``holding`` counts as true."""


# Name of the only image where an observation is no Dict.
IMAGE_KEY = "image"


class StackedImage(nn.Module):
    """One image of a Dict observation: the images' channels, and a constant channel for each other number.

    An observation that is an image already is taken as the only one. Of images of several sizes the largest
    are taken; :class:`~sb3_extensions.encoders.extractors.SmallImages` are the others, and point clouds,
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


class View(NamedTuple):
    """
    A batch of observations as the networks take them.

    :param image: the heightmap, standardised, (batch, 1, size, size)
    :param heights: the same, m, (batch, size, size)
    :param in_hand: the in-hand image, standardised, (batch, channels, side, side); None where there is none
    :param places: whether the gripper holds something, and so will place it, bool (batch,)
    """

    image: th.Tensor
    heights: th.Tensor
    in_hand: th.Tensor | None
    places: th.Tensor

    def of(self, samples: th.Tensor) -> View:
        """
        Some of the observations.

        :param samples: their numbers, or a mask, (batch,)
        """
        in_hand = None if self.in_hand is None else self.in_hand[samples]
        return View(self.image[samples], self.heights[samples], in_hand, self.places[samples])


class SceneView(nn.Module):
    """
    From a Dict observation to a :class:`View`.

    :param observation_space: with a heightmap (1, size, size), m, and perhaps an in-hand image and a number
        that says whether the gripper holds something; without it all actions are picks
    :param quantise: ``"uint8"`` or ``"uint16"``: what the replay buffer stores float images as; ``None`` if
        it stores floats
    :param standardise: (mean, standard deviation), m: images become (image - mean) / standard deviation
    :param image_key: of the heightmap
    :param in_hand_key: of the in-hand image
    :param holding_key: of whether the gripper holds something
    :raises ValueError: if there is no such heightmap, an image is not square, or the deviation is not
        positive
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        quantise: str | None = "uint8",
        standardise: Sequence[float] = (0.0, 1.0),
        image_key: str = "heightmap",
        in_hand_key: str = "in_hand",
        holding_key: str = "holding",
    ) -> None:
        super().__init__()
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {}
        image = parts.get(image_key)
        if not isinstance(image, spaces.Box) or len(image.shape) != IMAGE_AXES or image.shape[0] != 1:
            raise ValueError(
                f"observation_space must be a Dict with a heightmap (1, size, size) under {image_key!r}, "
                f"got {observation_space}"
            )
        in_hand = parts.get(in_hand_key)
        images = {image_key: image} | ({in_hand_key: in_hand} if isinstance(in_hand, spaces.Box) else {})
        for key, space in images.items():
            if len(space.shape) != IMAGE_AXES or space.shape[1] != space.shape[2]:
                raise ValueError(f"images must be square, (channels, side, side), {key!r} is {space.shape}")
        mean, deviation = standardise
        if deviation <= 0:
            raise ValueError(f"standardise must have a positive standard deviation, got {tuple(standardise)}")
        self.size = int(image.shape[1])
        self.in_hand_shape: tuple[int, int, int] | None = None
        if isinstance(in_hand, spaces.Box):
            channels, side, _ = in_hand.shape
            self.in_hand_shape = (channels, side, side)
        self.quantise, self.mean, self.deviation = quantise, mean, deviation
        self.quantisers = {key: Quantiser(space, quantise) for key, space in images.items() if quantise}
        self.image_key, self.in_hand_key = image_key, in_hand_key
        self.holding_key = holding_key if holding_key in parts else None

    has_float_images = True

    @property
    def image_keys(self) -> set[str]:
        """Keys of the images."""
        return {self.image_key} if self.in_hand_shape is None else {self.image_key, self.in_hand_key}

    def forward(self, observations: TensorDict) -> View:
        """
        :param observations: a batch
        :return: the view
        """
        heights = self._rounded(observations, self.image_key)
        in_hand = None
        if self.in_hand_shape is not None:
            in_hand = self.standardised(self._rounded(observations, self.in_hand_key))
        places = th.zeros(len(heights), dtype=th.bool, device=heights.device)
        if self.holding_key is not None:
            places = observations[self.holding_key].flatten(1)[:, 0] > HOLDS
        return View(self.standardised(heights), heights[:, 0], in_hand, places)

    def standardised(self, images: th.Tensor) -> th.Tensor:
        """
        Images in the units of the networks.

        :param images: m, any shape
        """
        return (images - self.mean) / self.deviation

    def _rounded(self, observations: TensorDict, key: str) -> th.Tensor:
        """As the replay buffer gives them back: an agent sees what it is trained on."""
        image = observations[key].float()
        return self.quantisers[key].round_trip(image) if key in self.quantisers else image
