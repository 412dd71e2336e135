"""Features extractors for Dict observations of images and numbers, for any Stable-Baselines3 algorithm."""

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.utils.cpp_extension import get_cxx_compiler

from sb3_extensions.common.observations import space_parts
from sb3_extensions.encoders.cnn import CnnEncoder, Encoder, scale_channels
from sb3_extensions.encoders.observation import StackedImage, square_images
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d, GroupMaxPool

SMALL_IMAGE_CHANNELS = (16, 32, 64)
"""Channels of the halving stages of the encoders of smaller images."""


class EquivariantEncoder(Encoder):
    """Encoder to regular fields: a rotation of the image permutes the numbers of each field.

    See :class:`~sb3_extensions.encoders.cnn.CnnEncoder` for the other parameters.

    :param group: symmetry group
    :param channels: regular fields after each stage; by default the paper's, for the size
    :param output: ``"regular"``, or ``"invariant"`` to reduce each field to its maximum
    :raises ValueError: if ``output`` is unknown, or see :class:`~sb3_extensions.encoders.cnn.Encoder`
    """

    # Close-loop equivariant baseline of the paper, 128 x 128 pixels.
    HALVING, LAST = (8, 16, 32, 64), (128, 64, 64)

    def __init__(
        self,
        in_channels: int,
        size: int,
        group: Group,
        channels: Sequence[int] | None = None,
        output: str = "regular",
        **kwargs: Any,
    ) -> None:
        if output not in ("regular", "invariant"):
            raise ValueError(f"output must be 'regular' or 'invariant', got {output!r}")
        channels = channels or scale_channels(size, self.HALVING, self.LAST)
        image = FieldType.of((group.trivial, in_channels))
        types = [image, *(FieldType.of((group.regular, count)) for count in channels)]
        super().__init__(EquivariantConv2d, types, size, **kwargs)
        self.pool = GroupMaxPool(types[-1]) if output == "invariant" else None
        self.out_type = types[-1] if self.pool is None else self.pool.out_type
        self.features_dim = self.out_type.size

    def forward(self, image: th.Tensor) -> th.Tensor:
        """:return: float32 features, (batch, features)"""
        features = super().forward(image)
        return features if self.pool is None else self.pool(features)


class ImageExtractor(BaseFeaturesExtractor):
    """Base class of the extractors: an encoder of the largest images and the numbers of an observation.

    Smaller images, such as ``in_hand``, have plain encoders, one for each size. Their features are appended.

    ``quantise`` and ``standardise`` apply to all images. See
    :class:`~sb3_extensions.encoders.observation.StackedImage` for the other parameters.

    :param channels: channels or regular fields after each stage; by default the paper's, for the size
    :param strided: number of halvings without pooling, None for all, see
        :func:`~sb3_extensions.encoders.cnn.plan_stages`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.encoders.cnn.Encoder`
    :param small_image_features: number of features of the smaller images of one size
    :param compile: whether to compile the encoder with ``torch.compile`` (one to two minutes)
    :raises ValueError: if the encoder does not match the images, or ``compile`` has no C++ compiler
    """

    encoder_class: Callable[..., Encoder]

    def __init__(
        self,
        observation_space: gym.Space[Any],
        channels: Sequence[int] | None = None,
        strided: int | None = None,
        quantise: str | None = "uint8",
        autocast: str | None = None,
        crop: int | None = None,
        standardise: Sequence[float] | None = None,
        above_ground: Sequence[float] | None = None,
        small_image_features: int = 32,
        compile: bool = False,
    ) -> None:
        if small_image_features < 1:
            raise ValueError(f"small_image_features must be at least 1, got {small_image_features}")
        stack = StackedImage(observation_space, quantise, crop, standardise, above_ground)
        encoder = self.encoder_class(
            stack.channels, stack.size, channels=channels, strided=strided, autocast=autocast
        )
        small_images = nn.ModuleList()
        for images in _small_images_by_size(observation_space):
            small = StackedImage(images, quantise, standardise=standardise)
            widths = scale_channels(small.size, SMALL_IMAGE_CHANNELS, (64, small_image_features))
            small_encoder = CnnEncoder(small.channels, small.size, widths, autocast=autocast)
            small_images.append(nn.Sequential(small, small_encoder))
        small_dim = small_image_features * len(small_images)
        super().__init__(observation_space, encoder.features_dim + small_dim)
        self.stack, self.encoder, self.small_images = stack, encoder, small_images
        if compile:
            if shutil.which(compiler := get_cxx_compiler()) is None:
                raise ValueError(
                    f"compile must be False without a C++ compiler, got True. Install {compiler}, or set CXX"
                )
            self.encoder.compile(dynamic=True)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features = self.encoder(self.stack(observations))
        return th.cat([features, *(encoder(observations) for encoder in self.small_images)], dim=1)


def _small_images_by_size(observation_space: gym.Space[Any]) -> list[spaces.Dict]:
    """Return the images of each size except the largest, larger ones first."""
    images = square_images(space_parts(observation_space))
    sizes = sorted({space.shape[1] for space in images.values()}, reverse=True)
    return [
        spaces.Dict({key: space for key, space in images.items() if space.shape[1] == size})
        for size in sizes[1:]
    ]


class CnnExtractor(ImageExtractor):
    """Plain convolutional encoder of images and numbers, see :class:`ImageExtractor` for the parameters."""

    encoder_class = CnnEncoder


class EquivariantExtractor(ImageExtractor):
    """Equivariant encoder of a Dict observation of images and numbers.

    Features of smaller images are trivial fields, which is correct for images in the frame of the gripper. A
    reflection mirrors these images, so with a dihedral group the features are equivariant to rotations only.

    :param observation_space: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param group: ``"cyclic"`` (rotations) or ``"dihedral"`` (rotations and reflections)
    :param n: number of rotations
    :param output: ``"regular"`` for regular fields, which equivariant heads need, or ``"invariant"`` for the
        maximum of each field. Any head is then invariant, which suits values but not directions of motion
    :param kwargs: further parameters of :class:`ImageExtractor`
    :raises ValueError: if ``group``, ``n`` or ``output`` is unknown, or the encoder does not match the images
    """

    encoder: EquivariantEncoder

    def __init__(
        self,
        observation_space: gym.Space[Any],
        group: str = "cyclic",
        n: int = 8,
        channels: Sequence[int] | None = None,
        output: str = "regular",
        **kwargs: Any,
    ) -> None:
        symmetry = Group(group, n)
        self.encoder_class = partial(EquivariantEncoder, group=symmetry, output=output)
        super().__init__(observation_space, channels, **kwargs)
        scene_type = self.encoder.out_type
        small_dim = self.features_dim - scene_type.size
        self.out_type = FieldType((*scene_type.fields, (symmetry.trivial, small_dim)))
