"""U-Nets from an image to a feature map of the same size: plain and equivariant (paper)."""

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
    Encoder and decoder with skip connections: (batch, channels, size, size) to a map of the same size.

    All steps keep the centre of an image of an even side, so rotations by 90 degrees are exact.

    :param downs: blocks of the encoder, one for each level; each level has half the side of the previous one
    :param ups: blocks of the decoder, from the lowest level. The input is the features of the level and the
        doubled features of the level below
    :param fuse: block that combines the lowest features with the features of a second image
    """

    def __init__(
        self, downs: Sequence[nn.Module], ups: Sequence[nn.Module], fuse: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.downs, self.ups = nn.ModuleList(downs), nn.ModuleList(ups)
        self.pool = HalvingMaxPool()
        self.fuse = fuse

    def forward(self, image: th.Tensor, other: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        :param image: (batch, channels, size, size)
        :param other: features of a second image, (batch, channels, side, side), resized to the lowest level
        :return: map of the size of the image, (batch, channels, size, size), and the lowest features
        """
        size = image.shape[-1]
        missing = -size % int(2 ** (len(self.downs) - 1))
        before, after = missing // 2, missing - missing // 2
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


def lowest_shape(size: int, channels: Sequence[int]) -> tuple[int, int, int]:
    """Return the shape (channels, side, side) of the lowest features of a U-Net."""
    if len(channels) < 2:
        raise ValueError(f"channels and fields must have at least two levels, got {channels}")
    side = -(-size // 2 ** (len(channels) - 1))
    return channels[-1], side, side


def double(features: th.Tensor) -> th.Tensor:
    """Double the side of feature maps by bilinear interpolation."""
    doubled = F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)
    if doubled.requires_grad:
        # The gradient of a concatenation is a slice. PyTorch is ten times as fast on contiguous memory.
        doubled.register_hook(lambda gradient: gradient.contiguous(memory_format=th.channels_last))
    return doubled


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with a shortcut: the identity, or a convolution if the channels change."""

    def __init__(self, first: nn.Module, second: nn.Module, skip: nn.Module) -> None:
        super().__init__()
        self.first, self.second, self.skip = first, second, skip

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels, height, width)"""
        shortcut: th.Tensor = self.skip(features)
        return F.relu(self.second(F.relu(self.first(features))) + shortcut)


def _plain_block(inputs: int, outputs: int) -> ResidualBlock:
    return ResidualBlock(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
        nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1, bias=False),
    )


def _equivariant_block(inputs: FieldType, outputs: FieldType, skip_kernel: int) -> ResidualBlock:
    def shortcut() -> nn.Module:
        padding = skip_kernel // 2
        return EquivariantConv2d(inputs, outputs, skip_kernel, padding=padding, bias=False, gain=1.0)

    return ResidualBlock(
        EquivariantConv2d(inputs, outputs, 3, padding=1, bias=False),
        EquivariantConv2d(outputs, outputs, 3, padding=1, bias=False, gain=1.0),
        nn.Identity() if inputs == outputs else shortcut(),
    )


def plain_unet(in_channels: int, channels: Sequence[int], other_channels: int) -> UNet:
    """
    Make the U-Net of the paper's plain networks (the authors' code), with Xavier normal weights.

    :param in_channels: channels of the image
    :param channels: channels of each level, from the image down; at least two levels
    :param other_channels: channels of the features of a second image, 0 without one
    """
    stem = nn.Sequential(nn.Conv2d(in_channels, channels[0], 3, padding=1), nn.ReLU(inplace=True))
    downs: list[nn.Module] = [nn.Sequential(stem, _plain_block(channels[0], channels[0]))]
    downs += [_plain_block(above, below) for above, below in pairwise(channels[:-1])]
    downs.append(_narrowed(channels[-2], 2 * channels[-1], channels[-1]))
    *lower, (side, below, above) = _decoder_channels(channels)
    ups: list[nn.Module] = [_narrowed(side + below, side, above) for side, below, above in lower]
    ups.append(_plain_block(side + below, above))
    fuse = _plain_block(channels[-1] + other_channels, channels[-1]) if other_channels else None
    net = UNet(downs, ups, fuse)
    net.apply(initialise_xavier)
    return net


def _decoder_channels(channels: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return channels of the level, of the level below and of the output for each block of the decoder."""
    outputs = [*channels[-3::-1], channels[0]]
    return list(zip(channels[-2::-1], [channels[-1], *outputs[:-1]], outputs, strict=True))


def _narrowed(in_channels: int, channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(_plain_block(in_channels, channels), nn.Conv2d(channels, out_channels, 1))


def equivariant_unet(in_channels: int, group: Group, fields: Sequence[int], skip_kernel: int = 3) -> UNet:
    """
    Make the equivariant U-Net (the authors' code) of regular fields and 3 x 3 filters.

    :param in_channels: channels of the image, all scalar (trivial fields)
    :param group: symmetry group
    :param fields: regular fields of each level, from the image down; at least two levels
    :param skip_kernel: side of the filters of shortcuts between different numbers of fields, 1 or 3
    """

    def regular(count: int) -> FieldType:
        return FieldType.of((group.regular, count))

    types, image = [regular(count) for count in fields], FieldType.of((group.trivial, in_channels))
    stem = nn.Sequential(EquivariantConv2d(image, types[0], 3, padding=1), nn.ReLU(inplace=True))
    downs: list[nn.Module] = [nn.Sequential(stem, _equivariant_block(types[0], types[0], skip_kernel))]
    downs += [_equivariant_block(above, below, skip_kernel) for above, below in pairwise(types)]
    ups = [
        _equivariant_block(regular(side + below), regular(above), skip_kernel)
        for side, below, above in _decoder_channels(fields)
    ]
    return UNet(downs, ups)
