"""Features extractors for Dict observations of images and numbers, for any Stable-Baselines3 algorithm."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_extensions.encoders.cnn import CnnEncoder, SmallImageEncoder
from sb3_extensions.encoders.equivariant import EquivariantEncoder
from sb3_extensions.encoders.observation import StackedImage, largest_images, square_images
from sb3_extensions.encoders.points import PointClouds
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import GroupMaxPool

OUTPUTS = ("regular", "invariant")
# A quarter of those of the largest images behind the paper's CNN.
SMALL_IMAGE_FEATURES = 32


class SmallImages(nn.Module):
    """Features of the images that are smaller than the largest, and of point clouds, appended to those of the
    largest.

    Images of one size are stacked, see :class:`~sb3_extensions.encoders.observation.StackedImage`, and
    encoded, see :class:`~sb3_extensions.encoders.cnn.SmallImageEncoder`; there may be none.

    :param observation_space: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param features: number of features of the images of one size
    :param initialise: draws the weights of a layer, as those of the encoder of the largest images are drawn:
        what comes from either is then about as large
    :param quantise: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param standardise: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param channels_last: see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param autocast: see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param invariant: see :class:`~sb3_extensions.encoders.points.PointEncoder`
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

    :param observation_space: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param channels: output channels of each stage, see :class:`~sb3_extensions.encoders.cnn.CnnEncoder`
    :param strided: halvings without pooling, see :func:`~sb3_extensions.encoders.cnn.plan_stages`
    :param quantise: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param channels_last: see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param crop: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param standardise: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param above_ground: see :class:`~sb3_extensions.encoders.observation.StackedImage`
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
        above_ground: Sequence[float] | None = None,
        small_image_features: int = SMALL_IMAGE_FEATURES,
    ) -> None:
        stack = StackedImage(observation_space, quantise, crop, standardise, above_ground)
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

    :param observation_space: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param group: ``"cyclic"`` (rotations) or ``"dihedral"`` (reflections too)
    :param n: number of rotations
    :param channels: regular fields after each stage, see
        :class:`~sb3_extensions.encoders.equivariant.EquivariantEncoder`
    :param strided: halvings without pooling, see :func:`~sb3_extensions.encoders.cnn.plan_stages`
    :param output: ``"regular"`` or ``"invariant"``
    :param quantise: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param channels_last: see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param crop: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param standardise: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param above_ground: see :class:`~sb3_extensions.encoders.observation.StackedImage`
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
        above_ground: Sequence[float] | None = None,
        small_image_features: int = SMALL_IMAGE_FEATURES,
    ) -> None:
        if output not in OUTPUTS:
            raise ValueError(f"output must be one of {OUTPUTS}, got {output!r}")
        stack = StackedImage(observation_space, quantise, crop, standardise, above_ground)
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
