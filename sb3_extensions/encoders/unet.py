"""U-Nets from an image to a feature map of the same size: the paper's plain one and its equivariant one.

Both halve the image by max-pooling, once a level, and double it again by bilinear interpolation, beside the
features of the same size on the way down. Every step keeps the centre of an image of an even side: rotations
by 90 degrees stay exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.cnn import HalvingMaxPool, resize
from sb3_extensions.encoders.initialisation import initialise_xavier
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d


class UNet(nn.Module):
    """
    Blocks on the way down and on the way up: (batch, channels, size, size) to a map of the same size.

    :param downs: from the image to the features of each level; each level's image has half the side of the
        one before
    :param ups: from the features of a level, beside the doubled ones of the level below, to those that go on;
        one less than ``downs``, the lowest first
    :param fuse: from the lowest features, beside those of a second image, to the lowest features
    """

    def __init__(
        self, downs: Sequence[nn.Module], ups: Sequence[nn.Module], fuse: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.downs, self.ups = nn.ModuleList(downs), nn.ModuleList(ups)
        self.pool = HalvingMaxPool()
        self.fuse = fuse

    @property
    def multiple(self) -> int:
        """What the sides of images are padded to a multiple of."""
        return int(2 ** (len(self.downs) - 1))

    def forward(self, image: th.Tensor, other: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        :param image: (batch, channels, size, size)
        :param other: features of a second image, (batch, channels, side, side), resized to the lowest level's
        :return: map of the image's size, (batch, channels, size, size), and the lowest features
        """
        size = image.shape[-1]
        before, after = split_padding(size, self.multiple)
        features = F.pad(image, (before, after, before, after))
        levels = []
        for index, down in enumerate(self.downs):
            features = down(self.pool(features) if index else features)
            features = features.contiguous(memory_format=th.channels_last)
            levels.append(features)
        features = levels.pop()
        if self.fuse is not None:
            assert other is not None
            features = self.fuse(th.cat([features, resize(other, features.shape[-1])], dim=1))
        lowest = features
        for up in self.ups:
            features = up(th.cat([levels.pop(), double(features)], dim=1))
        return features[..., before : before + size, before : before + size], lowest


def double(features: th.Tensor) -> th.Tensor:
    """
    Features of twice the side, interpolated bilinearly.

    :param features: (batch, channels, side, side)
    :return: (batch, channels, 2 side, 2 side)
    """
    doubled = F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)
    if doubled.requires_grad:
        # Behind a concatenation the gradient is a part of another's channels, which costs PyTorch ten times
        # as long as the same numbers kept together.
        doubled.register_hook(lambda gradient: gradient.contiguous(memory_format=th.channels_last))
    return doubled


def split_padding(size: int, multiple: int) -> tuple[int, int]:
    """
    Pixels to add before and behind, so that a side becomes a multiple.

    :param size: side, pixels
    :param multiple: the multiple
    """
    missing = -size % multiple
    return missing // 2, missing - missing // 2


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside an identity, or a 1 x 1 convolution where the channels change; no biases.

    :param in_channels: channels of the input
    :param out_channels: channels of the output
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False)
        self.second = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
        same = in_channels == out_channels
        self.skip = nn.Identity() if same else nn.Conv2d(in_channels, out_channels, 1, bias=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out_channels, height, width)"""
        beside: th.Tensor = self.skip(features)
        return F.relu(self.second(F.relu(self.first(features))) + beside)


class EquivariantResidualBlock(nn.Module):
    """Two 3 x 3 equivariant convolutions next to an identity, or to a 1 x 1 convolution if the fields change.

    :param in_type: fields of the input
    :param out_type: regular fields of the output
    """

    def __init__(self, in_type: FieldType, out_type: FieldType) -> None:
        super().__init__()
        self.first = EquivariantConv2d(in_type, out_type, 3, padding=1, bias=False)
        self.second = EquivariantConv2d(out_type, out_type, 3, padding=1, bias=False, gain=1.0)
        same = in_type == out_type
        self.skip = nn.Identity() if same else EquivariantConv2d(in_type, out_type, 1, bias=False, gain=1.0)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels, height, width)"""
        beside: th.Tensor = self.skip(features)
        return F.relu(self.second(F.relu(self.first(features))) + beside)


def plain_unet(in_channels: int, channels: Sequence[int], other_channels: int) -> UNet:
    """
    The U-Net of the paper's plain networks (the authors' code); weights Xavier normal.

    Its lowest blocks work on twice the channels.

    :param in_channels: channels of the image
    :param channels: of each level, from the image down; two or more
    :param other_channels: channels of the second image's features, 0 where there is none
    :raises ValueError: if there are fewer than two levels
    """
    check_levels("channels", channels)
    stem = nn.Sequential(nn.Conv2d(in_channels, channels[0], 3, padding=1), nn.ReLU(inplace=True))
    downs: list[nn.Module] = [nn.Sequential(stem, ResidualBlock(channels[0], channels[0]))]
    downs += [ResidualBlock(above, below) for above, below in pairwise(channels[:-1])]
    downs.append(_narrowed(channels[-2], 2 * channels[-1], channels[-1]))
    ups: list[nn.Module] = [
        _narrowed(side + below, side, above) for side, below, above in _way_up(channels)[:-1]
    ]
    ups.append(ResidualBlock(sum(_way_up(channels)[-1][:2]), channels[0]))
    fuse = ResidualBlock(channels[-1] + other_channels, channels[-1]) if other_channels else None
    net = UNet(downs, ups, fuse)
    net.apply(initialise_xavier)
    return net


def _way_up(channels: Sequence[int]) -> list[tuple[int, int, int]]:
    """For each level but the lowest, from below: channels of its own, from below, and to go on with."""
    leaving = [*channels[-3::-1], channels[0]]
    return list(zip(channels[-2::-1], [channels[-1], *leaving[:-1]], leaving, strict=True))


def _narrowed(in_channels: int, channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(ResidualBlock(in_channels, channels), nn.Conv2d(channels, out_channels, 1))


def equivariant_unet(in_channels: int, group: Group, fields: Sequence[int]) -> UNet:
    """
    The equivariant U-Net (the authors' code): regular fields, 3 x 3 filters.

    :param in_channels: channels of the image, all scalar (trivial fields)
    :param group: the symmetry
    :param fields: regular fields of each level, from the image down; two or more
    :raises ValueError: if there are fewer
    """
    check_levels("fields", fields)

    def regular(count: int) -> FieldType:
        return FieldType.of((group.regular, count))

    types, image = [regular(count) for count in fields], FieldType.of((group.trivial, in_channels))
    stem = nn.Sequential(EquivariantConv2d(image, types[0], 3, padding=1), nn.ReLU(inplace=True))
    downs: list[nn.Module] = [nn.Sequential(stem, EquivariantResidualBlock(types[0], types[0]))]
    downs += [EquivariantResidualBlock(above, below) for above, below in pairwise(types)]
    ups = [
        EquivariantResidualBlock(regular(side + below), regular(above))
        for side, below, above in _way_up(fields)
    ]
    return UNet(downs, ups)


def check_levels(name: str, widths: Sequence[int]) -> None:
    """
    Check an argument.

    :param name: of the argument
    :param widths: of each level
    :raises ValueError: if there are fewer than two
    """
    if len(widths) < 2:
        raise ValueError(f"{name} must name two levels or more, got {widths}")
