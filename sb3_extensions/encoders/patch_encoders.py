"""Encoders of patches and in-hand images of 10 to 40 pixels a side (the authors' code)."""

from collections.abc import Sequence
from itertools import pairwise

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_extensions.encoders.cnn import resize
from sb3_extensions.encoders.initialisation import initialise_xavier

LAST_SIDE = 8
"""Maximum side (pixels) of the map before the linear layers: 6 for images of 24 pixels, 5 for 40 pixels."""
LAST_SIDE_OF_PIXELS = 10
"""As :data:`LAST_SIDE`, for the in-hand image of the equivariant pixel maps."""
SMALLEST_SIDE = 10
"""Side (pixels) of the smallest image that :class:`PatchMap` reduces. Smaller images are resized to it."""


class PatchMap(nn.Sequential):
    """
    Three 3 x 3 convolutions without padding, with max-pooling before the last: 24 pixels a side become 8.

    :param in_channels: channels of the image
    :param channels: channels of the three convolutions
    :raises ValueError: if the number of entries of ``channels`` is not three
    """

    def __init__(self, in_channels: int, channels: Sequence[int]) -> None:
        if len(channels) != 3:
            raise ValueError(f"in_hand_channels must have 3 entries, got {channels}")
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
        resized = resize(image, max(image.shape[-1], SMALLEST_SIDE))
        features: th.Tensor = super().forward(resized)  # type: ignore[no-untyped-call]
        return features

    @staticmethod
    def side(size: int) -> int:
        """Return the side (pixels) of the map of an image with the side ``size``."""
        return (max(size, SMALLEST_SIDE) - 4) // 2 - 2


class PatchVector(nn.Sequential):
    """
    Convolutions with padding and linear layers: (batch, channels, size, size) to (batch, hidden[-1]).

    Max-pooling precedes each of the last convolutions, as often as the map is larger than ``last_side``.

    :param in_channels: channels of the image
    :param size: side of the image, pixels
    :param channels: channels of the convolutions
    :param hidden: units of the linear layers, at least one
    :param last_side: maximum side of the last map, pixels
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
        for index, (inputs, outputs) in enumerate(pairwise((in_channels, *channels))):
            layers += [nn.MaxPool2d(2)] if index >= first_halved else []
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True)]
        super().__init__(*layers, nn.Flatten(), *create_mlp(channels[-1] * sides[-1] ** 2, -1, list(hidden)))
        self.apply(initialise_xavier)
