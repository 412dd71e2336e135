"""Features extractors for Dict observations of images and numbers, for any Stable-Baselines3 algorithm."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_extensions.common.images import IMAGE_AXES, scene_images
from sb3_extensions.networks.encoders import CnnEncoder, EquivariantEncoder, SmallImageEncoder
from sb3_extensions.networks.equivariant import GroupMaxPool
from sb3_extensions.networks.groups import FieldType, Group
from sb3_extensions.networks.points import PointClouds, point_clouds
from sb3_extensions.replay.quantisation import Quantiser

OUTPUTS = ("regular", "invariant")
# Name of the only image where an observation is no Dict.
IMAGE_KEY = "image"
# A quarter of those of the largest images behind the paper's CNN.
SMALL_IMAGE_FEATURES = 32


class StackedImage(nn.Module):
    """One image of a Dict observation: the images' channels, and a constant channel for each other number.

    An observation that is an image already is taken as the only one. Of images of several sizes the largest
    are taken; :class:`SmallImages` are the others, and point clouds, (n, 3).

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
    :raises ValueError: if the space has no image or images of other shapes, their bounds cannot be
        quantised, the largest are smaller than the crop, or ``standardise`` is something else
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
        all_images = square_images(parts)
        images = largest_images(all_images)
        side = int(next(iter(images.values())).shape[1])
        if crop is not None and not 1 <= crop <= side:
            raise ValueError(f"crop must be from 1 to the images' size, {side}, got {crop}")
        self.size = crop or side
        self.quantise = quantise
        self.has_float_images = not all(is_image_space(space) for space in images.values())
        self.scales = {
            key: _Scale(
                key, space, quantise, None if self.has_float_images and is_image_space(space) else standardise
            )
            for key, space in images.items()
        }
        others = all_images.keys() | point_clouds(parts).keys()
        numbers = {key: space for key, space in parts.items() if key not in others}
        self.number_keys = list(numbers)
        self.channels = sum(int(space.shape[0]) for space in images.values())
        self.channels += sum(get_flattened_obs_dim(space) for space in numbers.values())

    @property
    def image_keys(self) -> set[str]:
        """Keys of the images."""
        return set(self.scales)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, channels, size, size)"""
        if isinstance(observations, th.Tensor):
            observations = {IMAGE_KEY: observations}
        images = [scale(crop_centre(observations[key], self.size)) for key, scale in self.scales.items()]
        numbers = [observations[key].flatten(1)[..., None, None] for key in self.number_keys]
        return th.cat(images + [number.expand(-1, -1, self.size, self.size) for number in numbers], dim=1)


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
        shapes = {key: space.shape for key, space in images.items()}
        advice = "" if images else "; numbers alone are for a StatePolicy or the MlpExtractor"
        raise ValueError(f"observation_space needs images, all (channels, size, size), got {shapes}{advice}")
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


class SmallImages(nn.Module):
    """Features of the images that are smaller than the largest, and of point clouds, appended to those of the
    largest.

    Images of one size are stacked, see :class:`StackedImage`, and encoded, see
    :class:`~sb3_extensions.networks.encoders.SmallImageEncoder`; there may be none.

    :param observation_space: see :class:`StackedImage`
    :param features: number of features of the images of one size
    :param initialise: draws the weights of a layer, as those of the encoder of the largest images are drawn:
        what comes from either is then about as large
    :param quantise: see :class:`StackedImage`
    :param standardise: see :class:`StackedImage`
    :param channels_last: see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param autocast: see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param invariant: see :class:`~sb3_extensions.networks.points.PointEncoder`
    :raises ValueError: if ``features`` is not positive, or the images cannot be stacked
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        features: int,
        initialise: Callable[[th.Tensor], th.Tensor],
        quantise: str | None = "uint8",
        standardise: Sequence[float] | None = None,
        channels_last: bool = True,
        autocast: str | None = None,
        invariant: bool = False,
    ) -> None:
        super().__init__()
        if features < 1:
            raise ValueError(f"small_image_features must be at least 1, got {features}")
        self.stacks, self.encoders = nn.ModuleList(), nn.ModuleList()
        for images in _small_images_by_size(observation_space):
            stack = StackedImage(spaces.Dict({**images}), quantise, standardise=standardise)
            self.stacks.append(stack)
            self.encoders.append(
                SmallImageEncoder(stack.channels, stack.size, features, initialise, channels_last, autocast)
            )
        self.clouds = PointClouds(observation_space, features, invariant)
        self.features_dim = features * len(self.stacks) + self.clouds.features_dim

    def forward(self, features: th.Tensor, observations: PyTorchObs) -> th.Tensor:
        """
        Append features.

        :param features: of the largest images, (batch, number of them)
        :param observations: batch
        :return: with those of the smaller images and the point clouds behind them, (batch, number of them +
            features_dim)
        """
        if not self.features_dim or isinstance(observations, th.Tensor):
            return features
        pairs = zip(self.encoders, self.stacks, strict=True)
        small = [encoder(stack(observations)) for encoder, stack in pairs]
        return th.cat([features, *small, *self.clouds(observations)], dim=1)


def _small_images_by_size(observation_space: gym.Space[Any]) -> list[dict[str, spaces.Box]]:
    """Spaces of all images but the largest, those of one size together, the larger ones first."""
    if not isinstance(observation_space, spaces.Dict):
        return []
    left: Mapping[str, spaces.Box] = square_images(observation_space.spaces)
    by_size: list[dict[str, spaces.Box]] = []
    while left:
        by_size.append(largest_images(left))
        left = {key: space for key, space in left.items() if key not in by_size[-1]}
    return by_size[1:]


class CnnExtractor(BaseFeaturesExtractor):
    """Plain convolutional encoder of a Dict observation of images and numbers.

    Images smaller than the largest, such as what is in the gripper, and point clouds, (n, 3), have small
    encoders of their own, whose features stand behind the others.

    :param observation_space: see :class:`StackedImage`
    :param channels: output channels of each stage, see :class:`~sb3_extensions.networks.encoders.CnnEncoder`
    :param strided: halvings without pooling, see :func:`~sb3_extensions.networks.encoders.plan_stages`
    :param quantise: see :class:`StackedImage`
    :param channels_last: see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.networks.encoders.Encoder`
    :param crop: see :class:`StackedImage`
    :param standardise: see :class:`StackedImage`
    :param small_image_features: number of features of the smaller images of one size, and of a point cloud
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
        small_image_features: int = SMALL_IMAGE_FEATURES,
    ) -> None:
        stack = StackedImage(observation_space, quantise, crop, standardise)
        encoder = CnnEncoder(stack.channels, stack.size, channels, strided, channels_last, autocast)
        # After the other encoder, whose weights are then the same whether there are small images or not
        small_images = SmallImages(
            observation_space,
            small_image_features,
            nn.init.xavier_normal_,
            quantise,
            standardise,
            channels_last,
            autocast,
        )
        super().__init__(observation_space, encoder.features_dim + small_images.features_dim)
        self.stack, self.encoder, self.small_images = stack, encoder, small_images

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features: th.Tensor = self.small_images(self.encoder(self.stack(observations)), observations)
        return features


class EquivariantExtractor(BaseFeaturesExtractor):
    """Equivariant encoder of a Dict observation: the largest images turn with the scene, smaller images and
    numbers do not.

    With ``output="regular"`` the features are regular fields, permuted when the images turn: for equivariant
    heads; behind an ordinary head (PPO's, TQC's) symmetry is lost there. With ``output="invariant"`` each
    field is reduced to its largest number: any head is then invariant, right for values, too poor for the
    direction of a motion.

    Images smaller than the largest have small plain encoders, whose features stand behind the others, as
    trivial fields, with either ``output``. That is right for what turns with the gripper, as what is in it:
    it stays as it is when the scene and the gripper's yaw turn together. A reflection mirrors it, which a
    plain encoder does not know: with ``"dihedral"`` the features keep the rotations' symmetry alone then.
    Features of point clouds stand there, too; they do not change when the points turn about the z axis.

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
    :param small_image_features: number of features of the smaller images of one size, and of a point cloud
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
        small_image_features: int = SMALL_IMAGE_FEATURES,
    ) -> None:
        if output not in OUTPUTS:
            raise ValueError(f"output must be one of {OUTPUTS}, got {output!r}")
        stack = StackedImage(observation_space, quantise, crop, standardise)
        symmetry = Group(group, n)
        encoder = EquivariantEncoder(
            stack.channels, stack.size, symmetry, channels, strided, channels_last, autocast
        )
        small_images = SmallImages(
            observation_space,
            small_image_features,
            nn.init.kaiming_normal_,
            quantise,
            standardise,
            channels_last,
            autocast,
            invariant=True,
        )
        pool = GroupMaxPool(encoder.out_type) if output == "invariant" else None
        scene_type = encoder.out_type if pool is None else pool.out_type
        out_type = FieldType((*scene_type.fields, (symmetry.trivial, small_images.features_dim)))
        super().__init__(observation_space, out_type.size)
        self.stack, self.encoder, self.pool, self.out_type = stack, encoder, pool, out_type
        self.small_images = small_images

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features: th.Tensor = self.encoder(self.stack(observations))
        features = features if self.pool is None else self.pool(features)
        features = self.small_images(features, observations)
        return features
