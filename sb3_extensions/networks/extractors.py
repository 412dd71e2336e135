"""Features extractors for Dict observations of images and numbers, for any Stable-Baselines3 algorithm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_extensions.networks.encoders import CnnEncoder, EquivariantEncoder
from sb3_extensions.networks.equivariant import GroupMaxPool
from sb3_extensions.networks.groups import Group
from sb3_extensions.replay.quantisation import Quantiser

OUTPUTS = ("regular", "invariant")
# Name of the only image where an observation is no Dict.
IMAGE_KEY = "image"


class StackedImage(nn.Module):
    """One image of a Dict observation: the images' channels, and a constant channel for each other number.

    An observation that is an image already is taken as the only one.

    Float images (such as heights in metres) are mapped from the bounds of their space to [0, 1], rounded to
    the levels that the replay buffer stores; ``uint8`` images arrive so from Stable-Baselines3 (its
    ``normalize_images`` must stay on). Numbers, and unrounded images without finite bounds, are taken as they
    are.

    :param observation_space: with at least one image, (channels, size, size), all of one size
    :param quantise: ``"uint8"`` or ``"uint16"``: what the replay buffer stores float images as; ``None`` if
        it stores floats
    :param crop: side, in pixels, of the part that is taken from the centre of larger images; images of this
        size, as cut out at random in training, are taken whole. ``None`` takes all images whole
    :param standardise: (mean, standard deviation) in the images' units (of ``uint8`` images: [0, 1]): they
        become (image - mean) / standard deviation instead of [0, 1]. What differs little within the bounds,
        as heights of a few centimetres, is then learnt in far fewer updates
    :raises ValueError: if the space has no image or images of other shapes, their bounds cannot be
        quantised, they are smaller than the crop, or ``standardise`` is something else
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        quantise: str | None,
        crop: int | None = None,
        standardise: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        parts = {IMAGE_KEY: observation_space}
        if isinstance(observation_space, spaces.Dict):
            parts = observation_space.spaces
        images = {
            key: space
            for key, space in parts.items()
            if isinstance(space, spaces.Box) and len(space.shape) == 3
        }
        shapes = {key: space.shape for key, space in images.items()}
        sides = {side for shape in shapes.values() for side in shape[1:]}
        if len(sides) != 1:
            raise ValueError(
                f"observation_space needs images (channels, size, size), of one size, got {shapes}"
            )
        side = int(sides.pop())
        if crop is not None and not 1 <= crop <= side:
            raise ValueError(f"crop must be from 1 to the images' size, {side}, got {crop}")
        self.size = crop or side
        self.scales = {key: _Scale(key, space, quantise, standardise) for key, space in images.items()}
        self.quantise = quantise
        self.has_float_images = not all(is_image_space(space) for space in images.values())
        numbers = {key: space for key, space in parts.items() if key not in images}
        self.number_keys = list(numbers)
        self.channels = sum(int(shape[0]) for shape in shapes.values())
        self.channels += sum(get_flattened_obs_dim(space) for space in numbers.values())

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, channels, size, size)"""
        if isinstance(observations, th.Tensor):
            observations = {IMAGE_KEY: observations}
        images = [scale(crop_centre(observations[key], self.size)) for key, scale in self.scales.items()]
        numbers = [observations[key].flatten(1)[..., None, None] for key in self.number_keys]
        return th.cat(images + [number.expand(-1, -1, self.size, self.size) for number in numbers], dim=1)


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
    """Maps an image to [0, 1], or standardises it.

    :param key: of the observation, for the error
    :param space: of the image
    :param quantise: see :class:`StackedImage`
    :param standardise: see :class:`StackedImage`
    :raises ValueError: if the space cannot be quantised so, or ``standardise`` is something else
    """

    def __init__(
        self, key: str, space: spaces.Box, quantise: str | None, standardise: Sequence[float] | None
    ) -> None:
        if standardise is not None and not (len(standardise) == 2 and standardise[1] > 0.0):
            raise ValueError(f"standardise must be (mean, standard deviation above 0), got {standardise}")
        self.standardise = standardise
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
            return
        low, high = float(space.low.min()), float(space.high.max())
        if math.isfinite(high - low) and high > low:
            self.low, self.span = low, high - low

    def __call__(self, image: th.Tensor) -> th.Tensor:
        if self.standardise is not None:
            mean, std = self.standardise
            rounded = image if self.quantiser is None else self.quantiser.round_trip(image)
            return (rounded - mean) / std
        if self.quantiser is not None:
            return self.quantiser.normalise(image)
        return (image - self.low) / self.span


class CnnExtractor(BaseFeaturesExtractor):
    """Plain convolutional encoder of a Dict observation of images and numbers.

    :param observation_space: see :class:`StackedImage`
    :param channels: output channels of each stage, see :class:`~sb3_extensions.networks.encoders.CnnEncoder`
    :param strided: halvings without pooling, see :func:`~sb3_extensions.networks.encoders.plan_stages`
    :param quantise: see :class:`StackedImage`
    :param channels_last: see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param crop: see :class:`StackedImage`
    :param standardise: see :class:`StackedImage`
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        channels: Sequence[int] | None = None,
        strided: int = 0,
        quantise: str | None = "uint8",
        channels_last: bool = True,
        autocast: str | None = None,
        crop: int | None = None,
        standardise: Sequence[float] | None = None,
    ) -> None:
        stack = StackedImage(observation_space, quantise, crop, standardise)
        encoder = CnnEncoder(stack.channels, stack.size, channels, strided, channels_last, autocast)
        super().__init__(observation_space, encoder.features_dim)
        self.stack, self.encoder = stack, encoder

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features: th.Tensor = self.encoder(self.stack(observations))
        return features


class EquivariantExtractor(BaseFeaturesExtractor):
    """Equivariant encoder of a Dict observation: images turn with the scene, numbers do not.

    With ``output="regular"`` the features are regular fields, permuted when the images turn: for equivariant
    heads; behind an ordinary head (PPO's, TQC's) symmetry is lost there. With ``output="invariant"`` each
    field is reduced to its largest number: any head is then invariant, right for values, too poor for the
    direction of a motion.

    :param observation_space: see :class:`StackedImage`
    :param group: ``"cyclic"`` (rotations) or ``"dihedral"`` (reflections too)
    :param n: number of rotations
    :param channels: regular fields after each stage, see
        :class:`~sb3_extensions.networks.encoders.EquivariantEncoder`
    :param strided: halvings without pooling, see :func:`~sb3_extensions.networks.encoders.plan_stages`
    :param output: ``"regular"`` or ``"invariant"``
    :param quantise: see :class:`StackedImage`
    :param channels_last: see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param crop: see :class:`StackedImage`
    :param standardise: see :class:`StackedImage`
    :raises ValueError: if ``group``, ``n`` or ``output`` is none of these, or the encoder does not fit the
        images
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        group: str = "cyclic",
        n: int = 8,
        channels: Sequence[int] | None = None,
        strided: int = 0,
        output: str = "regular",
        quantise: str | None = "uint8",
        channels_last: bool = True,
        autocast: str | None = None,
        crop: int | None = None,
        standardise: Sequence[float] | None = None,
    ) -> None:
        if output not in OUTPUTS:
            raise ValueError(f"output must be one of {OUTPUTS}, got {output!r}")
        stack = StackedImage(observation_space, quantise, crop, standardise)
        symmetry = Group(group, n)
        encoder = EquivariantEncoder(
            stack.channels, stack.size, symmetry, channels, strided, channels_last, autocast
        )
        pool = GroupMaxPool(encoder.out_type) if output == "invariant" else None
        out_type = encoder.out_type if pool is None else pool.out_type
        super().__init__(observation_space, out_type.size)
        self.stack, self.encoder, self.pool, self.out_type = stack, encoder, pool, out_type

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features: th.Tensor = self.encoder(self.stack(observations))
        return features if self.pool is None else self.pool(features)
