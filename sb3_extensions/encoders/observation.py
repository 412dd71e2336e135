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

from sb3_extensions.common.observations import IMAGE_AXES, as_parts, scene_images, space_parts
from sb3_extensions.replay.quantisation import Quantiser

HOLDING_THRESHOLD = 0.5
"""The gripper holds an object if the value of ``holding`` is larger."""


class StackedImage(nn.Module):
    """One image of an observation: the largest images, and a constant channel for each number.

    Float images (such as heights in metres) are rounded to the levels that the replay buffer stores, and
    mapped from the bounds of their space to [0, 1]. Numbers, and images without finite bounds, are unchanged.

    :param observation_space: an image (channels, size, size), or a Dict with at least one
    :param quantise: ``"uint8"`` or ``"uint16"``, the type in which the replay buffer stores float images;
        ``None`` for a buffer of floats
    :param crop: side (pixels) of the central part of larger images. ``None`` uses all images whole
    :param standardise: (mean, standard deviation) in the units of the images ([0, 1] for ``uint8``). Images
        become (image - mean) / standard deviation instead of [0, 1]. ``uint8`` images next to float images
        stay in [0, 1]
    :param above_ground: (mean, standard deviation) of the distance of the ground from the camera, in the
        units of the images. Float images, distances below a camera, become heights above the most distant
        point of each image. The distance of that point becomes a constant channel, standardised with
        ``above_ground``. ``standardise`` then applies to the heights
    :raises ValueError: if there is no image, there is a point cloud, an image is not square or has bounds
        that cannot be quantised, ``crop`` is larger than the images, or an argument is invalid
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
        parts = space_parts(observation_space)
        all_images = square_images(parts)
        largest = scene_images({key: space.shape for key, space in all_images.items()})
        side = int(all_images[largest[0]].shape[1])
        if crop is not None and not 1 <= crop <= side:
            raise ValueError(f"crop must be from 1 to the images' size, {side}, got {crop}")
        self.size = crop or side
        self.quantise = quantise
        self.has_float_images = not all(is_image_space(all_images[key]) for key in largest)
        if above_ground is not None and not self.has_float_images:
            raise ValueError(f"above_ground must be None for uint8 images, got {above_ground}")
        self.scales = {}
        for key in largest:
            # Colours next to heights have other units.
            is_colour = self.has_float_images and is_image_space(all_images[key])
            units = (None, None) if is_colour else (standardise, above_ground)
            self.scales[key] = ImageScale(all_images[key], quantise, *units)
        self.number_keys = [key for key in parts if key not in all_images]
        shapes = {key: parts[key].shape or () for key in self.number_keys}
        if clouds := [key for key, shape in shapes.items() if len(shape) == 2 and shape[-1] == 3]:
            raise ValueError(
                f"observation_space must not have point clouds (n, 3), got {clouds}. "
                "Remove them with gymnasium.wrappers.FilterObservation"
            )
        self.channels = sum(scale.channels for scale in self.scales.values())
        self.channels += sum(get_flattened_obs_dim(parts[key]) for key in self.number_keys)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, channels, size, size)"""
        parts = as_parts(observations)
        channels: list[th.Tensor] = []
        for key, scale in self.scales.items():
            image = parts[key]
            start = (image.shape[-1] - self.size) // 2
            channels += scale(image[..., start : start + self.size, start : start + self.size])
        channels += [parts[key].flatten(1)[..., None, None] for key in self.number_keys]
        return th.cat([channel.expand(-1, -1, self.size, self.size) for channel in channels], dim=1)


def square_images(parts: Mapping[str, gym.Space[Any]]) -> dict[str, spaces.Box]:
    """
    Return the spaces of the images of an observation, in order.

    :raises ValueError: if not all images are (channels, size, size), or there are none
    """
    images = {
        key: space
        for key, space in parts.items()
        if isinstance(space, spaces.Box) and len(space.shape) == IMAGE_AXES
    }
    if images and all(space.shape[1] == space.shape[2] for space in images.values()):
        return images
    shapes = {key: space.shape or space for key, space in parts.items()}
    advice = (
        "Use neither FlattenObservation nor FrameStackObservation for images, "
        "and a StatePolicy or the MlpExtractor for numbers alone."
    )
    if images:
        advice = "Use channels_order='first' with VecFrameStack."
    raise ValueError(
        f"observation_space must have images, all (channels, size, size), got {shapes}. {advice}"
    )


def check_standardise(name: str, value: Sequence[float] | None) -> None:
    """Raise a ValueError that names the argument unless it is None or (mean, positive deviation)."""
    if value is not None and not (len(value) == 2 and value[1] > 0.0):
        raise ValueError(f"{name} must be (mean, standard deviation above 0), got {value}")


class ImageScale:
    """Rounding and scaling of one image of an observation, see :class:`StackedImage` for the parameters."""

    def __init__(
        self,
        space: spaces.Box,
        quantise: str | None,
        standardise: Sequence[float] | None = None,
        above_ground: Sequence[float] | None = None,
    ) -> None:
        check_standardise("standardise", standardise)
        check_standardise("above_ground", above_ground)
        self.standardise, self.above_ground = standardise, above_ground
        self.channels = int(space.shape[0]) * (1 if above_ground is None else 2)
        self.quantiser: Quantiser | None = None
        self.low, self.span = 0.0, 1.0
        if is_image_space(space):
            return
        if quantise is not None:
            self.quantiser = Quantiser(space, quantise)
        low, high = float(space.low.min()), float(space.high.max())
        if math.isfinite(high - low) and high > low:
            self.low, self.span = low, high - low

    def __call__(self, image: th.Tensor) -> tuple[th.Tensor, ...]:
        """:return: (batch, channels, size, size), for constant channels (batch, channels, 1, 1)"""
        if self.above_ground is not None:
            distances = self.round(image)
            ground = distances.amax(dim=(-2, -1), keepdim=True)
            mean, std = self.above_ground
            lowest, unit = self.standardise or (0.0, self.span)
            return (ground - distances - lowest) / unit, (ground - mean) / std
        if self.standardise is not None:
            mean, std = self.standardise
            return ((self.round(image) - mean) / std,)
        if self.quantiser is not None:
            return (self.quantiser.normalise(image),)
        return ((image - self.low) / self.span,)

    def round(self, image: th.Tensor) -> th.Tensor:
        """Return an image with the values that the replay buffer returns."""
        return image.float() if self.quantiser is None else self.quantiser.round_trip(image)


class View(NamedTuple):
    """
    Batch of inputs of the spatial Q networks.

    :param image: standardised heightmap, (batch, 1, size, size)
    :param heights: heightmap in metres, (batch, size, size)
    :param in_hand: standardised in-hand image, (batch, channels, side, side), or None
    :param places: whether the next primitive is a place, because the gripper holds an object, bool (batch,)
    """

    image: th.Tensor
    heights: th.Tensor
    in_hand: th.Tensor | None
    places: th.Tensor

    def of(self, samples: th.Tensor) -> View:
        """Return a part of the batch, of which ``samples`` are indices or a mask, (batch,)."""
        in_hand = None if self.in_hand is None else self.in_hand[samples]
        return View(self.image[samples], self.heights[samples], in_hand, self.places[samples])


class SceneView(nn.Module):
    """
    Conversion of a Dict observation to a :class:`View`.

    :param observation_space: Dict with a heightmap (1, size, size) in metres. An in-hand image (channels,
        side, side) and the number ``holding`` are optional; without ``holding`` all primitives are picks
    :param quantise: see :class:`StackedImage`
    :param standardise: (mean, standard deviation) of both images, m
    :param image_key: name of the heightmap
    :param in_hand_key: name of the in-hand image
    :param holding_key: name of the number that is 1 if the gripper holds an object
    :param patch_scale: factor of the standardised in-hand image, and of patches of the heightmap
    :raises ValueError: if there is no such heightmap, or see :class:`StackedImage`
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        quantise: str | None = "uint8",
        standardise: Sequence[float] = (0.0, 1.0),
        image_key: str = "heightmap",
        in_hand_key: str = "in_hand",
        holding_key: str = "holding",
        patch_scale: float = 1.0,
    ) -> None:
        super().__init__()
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {}
        shape = getattr(parts.get(image_key), "shape", None)
        if shape is None or len(shape) != IMAGE_AXES or shape[0] != 1:
            raise ValueError(
                f"observation_space must be a Dict with a heightmap (1, size, size) under {image_key!r}, "
                f"got {observation_space}"
            )

        def stack(key: str) -> StackedImage:
            return StackedImage(spaces.Dict({key: parts[key]}), quantise, standardise=standardise)

        self.heightmap = stack(image_key)
        self.size = self.heightmap.size
        """Side of the heightmap, pixels."""
        self.in_hand = stack(in_hand_key) if in_hand_key in parts else None
        self.in_hand_shape = None if self.in_hand is None else (self.in_hand.channels, self.in_hand.size)
        """Number of channels and side (pixels) of the in-hand image, None without one."""
        self.standardise, self.patch_scale = standardise, patch_scale
        self.image_key = image_key
        self.holding_key = holding_key if holding_key in parts else None

    def forward(self, observations: TensorDict) -> View:
        """:return: view of a batch of observations"""
        image = self.heightmap(observations)
        heights = self.heightmap.scales[self.image_key].round(observations[self.image_key])[:, 0]
        in_hand = None if self.in_hand is None else self.patch_scale * self.in_hand(observations)
        places = th.zeros(len(heights), dtype=th.bool, device=heights.device)
        if self.holding_key is not None:
            places = observations[self.holding_key].flatten(1)[:, 0] > HOLDING_THRESHOLD
        return View(image, heights, in_hand, places)
