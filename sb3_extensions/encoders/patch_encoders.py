"""Encoders of patches and in-hand images, some ten to forty pixels a side (the authors' code)."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_extensions.encoders.cnn import resize
from sb3_extensions.encoders.initialisation import initialise_xavier

# Side of the map before the linear layers, at most: 24 pixels become 6, 40 become 5, in the level of all
# pixels 10.
LAST_SIDE = 8
LAST_SIDE_OF_PIXELS = 10
CONVOLUTIONS = 3  # of the plain networks' encoder
SMALLEST_SIDE = 10
"""Side (pixels) of the smallest image that :class:`PatchMap` reduces. Smaller images are resized to it."""


class PatchMap(nn.Sequential):
    """
    Three 3 x 3 convolutions without padding, the image halved before the last: 24 pixels a side become 8.

    Images of fewer than 10 pixels a side are resized to 10 pixels.

    :param in_channels: channels of the image
    :param channels: of the three convolutions
    :raises ValueError: if they are not three
    """

    def __init__(self, in_channels: int, channels: Sequence[int]) -> None:
        if len(channels) != CONVOLUTIONS:
            raise ValueError(f"{CONVOLUTIONS} in_hand_channels are needed, one a convolution, got {channels}")
        first, second, third = channels
        super().__init__(
            nn.Conv2d(in_channels, first, 3),
            nn.ReLU(inplace=True),
            nn.Conv2d(first, second, 3),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2),
            nn.Conv2d(second, third, 3),
            nn.ReLU(inplace=True),
        )
        self.apply(initialise_xavier)

    def forward(self, image: th.Tensor) -> th.Tensor:
        """:return: (batch, channels[-1], side, side), see :meth:`side`"""
        features = resize(image, max(image.shape[-1], SMALLEST_SIDE))
        for layer in self:
            features = layer(features)
        return features

    @staticmethod
    def side(size: int) -> int:
        """
        Return the side of the map, pixels.

        :param size: side of the image, pixels
        """
        return (max(size, SMALLEST_SIDE) - 4) // 2 - 2


class PatchVector(nn.Sequential):
    """
    Convolutions that keep the size, the image halved before the last of them until it is small, and linear
    layers: (batch, channels, size, size) to (batch, hidden[-1]), behind a ReLU.

    :param in_channels: channels of the image
    :param size: side of the image, pixels
    :param channels: of the convolutions
    :param hidden: units of the linear layers, one or more
    :param last_side: side of the last map, pixels; it may stay larger, as the first convolution is never
        halved
    """

    def __init__(
        self,
        in_channels: int,
        size: int,
        channels: Sequence[int],
        hidden: Sequence[int],
        last_side: int = LAST_SIDE,
    ) -> None:
        layers: list[nn.Module] = []
        sides = [size]
        while sides[-1] > last_side and len(sides) < len(channels):
            sides.append(sides[-1] // 2)
        first_halved = len(channels) - len(sides) + 1
        for index, (inputs, outputs) in enumerate(zip((in_channels, *channels), channels, strict=False)):
            layers += [nn.MaxPool2d(2)] if index >= first_halved else []
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True)]
        super().__init__(*layers, nn.Flatten(), *mlp(channels[-1] * sides[-1] ** 2, hidden))
        self.apply(initialise_xavier)


def mlp(features: int, hidden: Sequence[int]) -> list[nn.Module]:
    """
    Linear layers, each with a ReLU behind it.

    :param features: numbers that come in
    :param hidden: units of each layer
    """
    layers: list[nn.Module] = []
    for inputs, outputs in zip((features, *hidden), hidden, strict=False):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return layers
