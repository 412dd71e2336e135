"""Networks that value every pixel of a heightmap as the place of a pick or a place (paper, Open-Loop 3D
Benchmark).

The input is a :class:`~sb3_extensions.encoders.observation.View`. The outputs are the values of all pixels,
(batch, yaws, size, size), for the next primitive and one or several yaws, and an encoding of the scene for
the levels that follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.initialisation import OUTPUT_GAIN, scale_down
from sb3_extensions.encoders.observation import View
from sb3_extensions.encoders.patch_encoders import LAST_SIDE_OF_PIXELS, PatchMap, PatchVector
from sb3_extensions.encoders.unet import equivariant_unet, plain_unet, split_padding
from sb3_extensions.equivariant.convolution import apply_in_float32
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import (
    DynamicEquivariantConv2d,
    EquivariantConv2d,
    GroupMaxPool,
)
from sb3_extensions.spatial_dqn.patches import rotate_images

PRIMITIVES = 2  # pick and place
HEAD_CHANNELS = 16  # of the authors' heads for one yaw: with a few, all their ReLUs may be silent for ever


@dataclass(frozen=True)
class Shapes:
    """
    Shapes of what a network sees.

    :param size: side of the heightmap, pixels
    :param in_hand: of the in-hand image, (channels, side, side), None where there is none
    """

    size: int
    in_hand: tuple[int, int, int] | None

    def encoding(self, channels: int, levels: int) -> tuple[int, int, int]:
        """
        Shape of the lowest features of a U-Net.

        :param channels: their number
        :param levels: of the U-Net
        """
        multiple = 2 ** (levels - 1)
        side = (self.size + sum(split_padding(self.size, multiple))) // multiple
        return channels, side, side


class PixelMaps(nn.Module):
    """
    What they have in common.

    :param rotations: number of yaws
    :param encoding_shape: of the encoding, (channels, side, side)
    """

    def __init__(self, rotations: int, encoding_shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.rotations, self.encoding_shape = rotations, encoding_shape

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """
        :param view: what is seen
        :return: values (batch, yaws, size, size), encoding
        """
        raise NotImplementedError


class PlainPixelMaps(PixelMaps):
    """
    A U-Net that sees the in-hand image beside its lowest features.

    :param shapes: of the images
    :param channels: of each level, see :func:`~sb3_extensions.encoders.unet.plain_unet`
    :param in_hand_channels: of the three convolutions on the in-hand image
    :param rotations: number of yaws
    :raises ValueError: if the convolutions are not three
    """

    def __init__(
        self, shapes: Shapes, channels: Sequence[int], in_hand_channels: Sequence[int], rotations: int = 1
    ) -> None:
        super().__init__(rotations, shapes.encoding(channels[-1], len(channels)))
        self.in_hand: PatchMap | None = None
        if shapes.in_hand is not None:
            self.in_hand = PatchMap(shapes.in_hand[0], in_hand_channels)
        self.unet = plain_unet(1, channels, 0 if self.in_hand is None else in_hand_channels[-1])
        self.head = nn.Conv2d(channels[0], PRIMITIVES * rotations, 1)
        scale_down(self.head)

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values (batch, yaws, size, size), encoding"""
        in_hand = None if self.in_hand is None else self.in_hand(view.in_hand)
        features, encoding = self.unet(view.image, in_hand)
        values = apply_in_float32(self.head, features).unflatten(1, (PRIMITIVES, self.rotations))
        return of_primitive(values, view.places), encoding


class RotatedPixelMaps(PixelMaps):
    """
    One network on the heightmap turned back by each yaw, its maps turned forth again (Rot FCN,
    https://arxiv.org/abs/1803.09956).

    :param shapes: of the images
    :param channels: see :class:`PlainPixelMaps`
    :param in_hand_channels: see :class:`PlainPixelMaps`
    :param rotations: number of yaws, over half a turn
    """

    def __init__(
        self, shapes: Shapes, channels: Sequence[int], in_hand_channels: Sequence[int], rotations: int
    ) -> None:
        multiple = 2 ** (len(channels) - 1)
        canvas = math.ceil(shapes.size * math.sqrt(2.0) / multiple) * multiple
        network = PlainPixelMaps(Shapes(canvas, shapes.in_hand), channels, in_hand_channels)
        super().__init__(rotations, network.encoding_shape)
        self.network, self.canvas = network, canvas
        angles = th.arange(rotations) * (math.pi / rotations)
        self.register_buffer("angles", angles, persistent=False)
        self.angles: th.Tensor

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values (batch, yaws, size, size), encoding of the first yaw's image"""
        batch, size = len(view.image), view.image.shape[-1]
        samples = th.arange(batch, device=view.image.device).repeat_interleave(self.rotations)
        angles = self.angles.repeat(batch)
        turned = view.of(samples)._replace(image=rotate_images(view.image[samples], -angles, self.canvas))
        maps, encoding = self.network(turned)
        values = rotate_images(maps.float(), angles, size)
        return values.view(batch, self.rotations, size, size), encoding[:: self.rotations]


class EquivariantPixelMaps(PixelMaps):
    """
    An equivariant U-Net; where something is to be placed, an encoder of the in-hand image gives the
    coefficients of one more filter.

    With one yaw its maps turn with the heightmap. With several, of C_2n for n yaws, they turn and are
    permuted: a gripper turned by half a turn is the same.

    :param shapes: of the images
    :param group: the symmetry
    :param fields: regular fields of each level, see :func:`~sb3_extensions.encoders.unet.equivariant_unet`
    :param in_hand_channels: of the convolutions on the in-hand image
    :param hidden: units of the linear layer behind them
    :param rotations: number of yaws: 1, or half of the group's rotations
    :param dynamic_fields: regular fields behind the filter that these make, as many as before it (the
        authors' code) if None. Of one or two a ReLU may be silent everywhere, for ever
    :raises ValueError: if the yaws do not fit the group, or ``dynamic_fields`` is less than 1
    """

    def __init__(
        self,
        shapes: Shapes,
        group: Group,
        fields: Sequence[int],
        in_hand_channels: Sequence[int],
        hidden: int,
        rotations: int = 1,
        dynamic_fields: int | None = None,
    ) -> None:
        if rotations != 1 and (group.family, group.n) != ("cyclic", 2 * rotations):
            raise ValueError(
                f"{rotations} yaws need the cyclic group of {2 * rotations} rotations, got {group}"
            )
        if dynamic_fields is not None and dynamic_fields < 1:
            raise ValueError(f"dynamic_fields must be at least 1, got {dynamic_fields}")
        super().__init__(rotations, shapes.encoding(fields[-1], len(fields)))
        regular, lowest = (FieldType.of((group.regular, fields[level])) for level in (0, -1))
        self.unet = equivariant_unet(1, group, fields)
        self.pool = GroupMaxPool(lowest)
        self.dynamic: DynamicEquivariantConv2d | None = None
        placed = regular
        if shapes.in_hand is not None:
            placed = FieldType.of((group.regular, dynamic_fields or fields[0]))
            self.dynamic = DynamicEquivariantConv2d(regular, placed, 3, padding=1)
            channels, side, _ = shapes.in_hand
            encoder = PatchVector(channels, side, in_hand_channels, [hidden], LAST_SIDE_OF_PIXELS)
            self.coefficients = nn.Sequential(encoder, coefficients_of(self.dynamic, hidden))
        self.heads = nn.ModuleList(_head(in_type, rotations) for in_type in (regular, placed))

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values (batch, yaws, size, size), encoding"""
        features, lowest = self.unet(view.image)
        return self._values(features, view), self.pool(lowest)

    def _values(self, features: th.Tensor, view: View) -> th.Tensor:
        """Return values of the next primitive: (batch, yaws, size, size)."""
        if (
            th.compiler.is_compiling() or th._C._get_tracing_state() is not None
        ):  # a graph has no branches that depend on data
            picks, places = self._pick_values(features), self._place_values(features, view.in_hand)
            return th.where(view.places[:, None, None, None], places, picks)
        values = features.new_zeros(len(features), self.rotations, *features.shape[2:], dtype=th.float32)
        if (~view.places).any():
            values[~view.places] = self._pick_values(features[~view.places])
        if view.places.any():
            placed = view.of(view.places)
            values[view.places] = self._place_values(features[view.places], placed.in_hand)
        return values

    def _pick_values(self, features: th.Tensor) -> th.Tensor:
        return _apply_head(self.heads[0], features)

    def _place_values(self, features: th.Tensor, in_hand: th.Tensor | None) -> th.Tensor:
        if self.dynamic is not None:
            features = F.relu(self.dynamic(features, self.coefficients(in_hand)))
        return _apply_head(self.heads[1], features)


def _apply_head(head: nn.Module, features: th.Tensor) -> th.Tensor:
    """Apply the layers of a head, the last one in float32."""
    *hidden, last = head.children()
    for layer in hidden:
        features = layer(features)
    return apply_in_float32(last, features)


def _head(regular: FieldType, rotations: int) -> nn.Sequential:
    """From regular fields to the values of one yaw, or of all of them."""
    group = regular.group
    if rotations > 1:
        yaws = FieldType.of((group.quotient(2), 1))
        return nn.Sequential(EquivariantConv2d(regular, yaws, 1, gain=OUTPUT_GAIN))
    hidden, value = (FieldType.of((group.trivial, count)) for count in (HEAD_CHANNELS, 1))
    return nn.Sequential(
        EquivariantConv2d(regular, hidden, 3, padding=1),
        nn.ReLU(inplace=True),
        EquivariantConv2d(hidden, value, 1, gain=OUTPUT_GAIN),
    )


def coefficients_of(dynamic: DynamicEquivariantConv2d, features: int) -> nn.Linear:
    """
    A layer that makes the coefficients of a dynamic filter. It begins with a random filter, of the size that
    others begin with, which what is seen changes a little: a layer that began near zero would silence all
    that passes the filter, and hardly learn.

    :param dynamic: the convolution with that filter
    :param features: numbers that come in
    """
    layer = nn.Linear(features, dynamic.num_coefficients)
    nn.init.normal_(layer.bias)
    with th.no_grad():
        layer.bias[-dynamic.num_biases :] = 0.0
    return layer


def of_primitive(values: th.Tensor, places: th.Tensor) -> th.Tensor:
    """
    Values of what the gripper does next.

    :param values: (batch, pick and place, ...)
    :param places: bool (batch,)
    :return: (batch, ...), float32
    """
    samples = th.arange(len(values), device=values.device)
    return values[samples, places.long()].float()
