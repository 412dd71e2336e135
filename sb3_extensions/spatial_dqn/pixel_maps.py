"""Networks that value a pick or a place at every pixel of a heightmap (paper, Open-Loop 3D Benchmark)."""

import math
from collections.abc import Sequence

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.common.components import check_integer
from sb3_extensions.encoders.initialisation import initialise_output
from sb3_extensions.encoders.observation import View
from sb3_extensions.encoders.patch_encoders import LAST_SIDE_OF_PIXELS, PatchMap, PatchVector
from sb3_extensions.encoders.unet import equivariant_unet, lowest_shape, plain_unet
from sb3_extensions.equivariant.convolution import apply_in_float32
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import DynamicEquivariantConv2d, EquivariantConv2d, GroupMaxPool
from sb3_extensions.spatial_dqn.patches import rotate_zero_padded

PRIMITIVES = 2
"""Number of primitives: pick and place."""
HEAD_CHANNELS = 16
"""Channels of the head for one yaw (the authors' code)."""

# Channels and fields of the authors' code, for 128 x 128 pixels.
CHANNELS = (32, 64, 128, 256, 256)
FIELDS = (16, 32, 64, 128, 128)
PATCH_MAP_CHANNELS = (64, 128, 256)
IN_HAND_CHANNELS = (32, 64, 128, 256)

InHandShape = tuple[int, int] | None
"""Number of channels and side (pixels) of the in-hand image, None without one."""


class PixelMaps(nn.Module):
    """
    Base class of the networks.

    :param rotations: number of yaws
    :param encoding_shape: shape of the encoding, (channels, side, side)
    """

    def __init__(self, rotations: int, encoding_shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.rotations, self.encoding_shape = rotations, encoding_shape

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values of the next primitive (batch, yaws, size, size), encoding of the scene"""
        raise NotImplementedError


class PlainPixelMaps(PixelMaps):
    """
    U-Net whose lowest features are combined with features of the in-hand image.

    :param size: side of the heightmap, pixels
    :param in_hand: shape of the in-hand image
    :param channels: channels of each level, see :func:`~sb3_extensions.encoders.unet.plain_unet`
    :param in_hand_channels: channels of the three convolutions on the in-hand image
    :param rotations: number of yaws
    :param output_gain: factor of the initial weights of the last layer
    """

    def __init__(
        self,
        size: int,
        in_hand: InHandShape,
        channels: Sequence[int] = CHANNELS,
        in_hand_channels: Sequence[int] = PATCH_MAP_CHANNELS,
        rotations: int = 1,
        output_gain: float = 1.0,
    ) -> None:
        super().__init__(rotations, lowest_shape(size, channels))
        self.in_hand = PatchMap(in_hand[0], in_hand_channels) if in_hand else None
        self.unet = plain_unet(1, channels, in_hand_channels[-1] if in_hand else 0)
        self.head = nn.Conv2d(channels[0], PRIMITIVES * rotations, 1)
        initialise_output(self.head, output_gain)

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values (batch, yaws, size, size), encoding"""
        in_hand = None if self.in_hand is None else self.in_hand(view.in_hand)
        features, encoding = self.unet(view.image, in_hand)
        values = apply_in_float32(self.head, features).unflatten(1, (PRIMITIVES, self.rotations))
        return of_primitive(values, view.places), encoding


class RotatedPixelMaps(PixelMaps):
    """
    One network on the heightmap rotated by each negative yaw, with its maps rotated back (Rot FCN,
    https://arxiv.org/abs/1803.09956).

    See :class:`PlainPixelMaps` for the other parameters.

    :param rotations: number of yaws in a range of pi
    """

    angles: th.Tensor

    def __init__(
        self,
        size: int,
        in_hand: InHandShape,
        channels: Sequence[int] = CHANNELS,
        in_hand_channels: Sequence[int] = PATCH_MAP_CHANNELS,
        rotations: int = 1,
        output_gain: float = 1.0,
    ) -> None:
        multiple = 2 ** (len(channels) - 1)
        canvas = math.ceil(size * math.sqrt(2.0) / multiple) * multiple
        network = PlainPixelMaps(canvas, in_hand, channels, in_hand_channels, output_gain=output_gain)
        super().__init__(rotations, network.encoding_shape)
        self.network, self.canvas = network, canvas
        angles = th.arange(rotations) * (math.pi / rotations)
        self.register_buffer("angles", angles, persistent=False)

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values (batch, yaws, size, size), encoding of the image of the first yaw"""
        batch, size = len(view.image), view.image.shape[-1]
        samples = th.arange(batch, device=view.image.device).repeat_interleave(self.rotations)
        angles = self.angles.repeat(batch)
        rotated = view.of(samples)._replace(
            image=rotate_zero_padded(view.image[samples], -angles, self.canvas)
        )
        maps, encoding = self.network(rotated)
        values = rotate_zero_padded(maps.float(), angles, size)
        return values.view(batch, self.rotations, size, size), encoding[:: self.rotations]


class EquivariantPixelMaps(PixelMaps):
    """
    Equivariant U-Net; for places, an encoder of the in-hand image predicts one more filter.

    With one yaw the maps rotate with the heightmap. With n yaws (group C_2n) they rotate and are permuted,
    because a rotation of the gripper by pi is the same pose.

    See :class:`PlainPixelMaps` for the other parameters.

    :param group: symmetry group
    :param fields: regular fields of each level, see :func:`~sb3_extensions.encoders.unet.equivariant_unet`
    :param in_hand_channels: channels of the convolutions on the in-hand image
    :param hidden: units of the linear layer on the in-hand image
    :param rotations: number of yaws: 1, or half of the group's rotations
    :param dynamic_fields: regular fields after the predicted filter, by default ``fields[0]`` (the authors'
        code). With one or two fields the ReLU may be inactive everywhere, forever
    :param skip_kernel: see :func:`~sb3_extensions.encoders.unet.equivariant_unet`
    :raises ValueError: if the yaws do not match the group, or ``dynamic_fields`` is not positive
    """

    def __init__(
        self,
        size: int,
        in_hand: InHandShape,
        group: Group,
        fields: Sequence[int] = FIELDS,
        in_hand_channels: Sequence[int] = IN_HAND_CHANNELS,
        hidden: int = 1024,
        rotations: int = 1,
        dynamic_fields: int | None = None,
        output_gain: float = 1.0,
        skip_kernel: int = 3,
    ) -> None:
        if rotations != 1 and (group.family, group.n) != ("cyclic", 2 * rotations):
            raise ValueError(
                f"group must be cyclic with {2 * rotations} rotations for {rotations} yaws, got {group}"
            )
        dynamic_fields = fields[0] if dynamic_fields is None else dynamic_fields
        check_integer(1, dynamic_fields=dynamic_fields)
        super().__init__(rotations, lowest_shape(size, fields))
        regular, lowest = (FieldType.of((group.regular, fields[level])) for level in (0, -1))
        self.unet = equivariant_unet(1, group, fields, skip_kernel)
        self.pool = GroupMaxPool(lowest)
        self.dynamic: DynamicEquivariantConv2d | None = None
        placed = regular
        if in_hand is not None:
            placed = FieldType.of((group.regular, dynamic_fields))
            self.dynamic = DynamicEquivariantConv2d(regular, placed, 3, padding=1)
            encoder = PatchVector(*in_hand, in_hand_channels, [hidden], LAST_SIDE_OF_PIXELS)
            self.coefficients = nn.Sequential(encoder, coefficient_layer(self.dynamic, hidden))
        self.heads = nn.ModuleList(_head(in_type, rotations, output_gain) for in_type in (regular, placed))

    def forward(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """:return: values (batch, yaws, size, size), encoding"""
        features, lowest = self.unet(view.image)
        return self._values(features, view), self.pool(lowest)

    def _values(self, features: th.Tensor, view: View) -> th.Tensor:
        """Return the values of the next primitive, (batch, yaws, size, size)."""
        if th.compiler.is_compiling() or th._C._get_tracing_state() is not None:
            # An exported graph has no branches that depend on data.
            picks, places = _apply_head(self.heads[0], features), self._place_values(features, view.in_hand)
            return th.where(view.places[:, None, None, None], places, picks)
        values = features.new_zeros(len(features), self.rotations, *features.shape[2:], dtype=th.float32)
        if (~view.places).any():
            values[~view.places] = _apply_head(self.heads[0], features[~view.places])
        if view.places.any():
            placed = view.of(view.places)
            values[view.places] = self._place_values(features[view.places], placed.in_hand)
        return values

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


def _head(regular: FieldType, rotations: int, gain: float) -> nn.Sequential:
    """Return the layers from regular fields to the values of all yaws."""
    group = regular.group
    if rotations > 1:
        yaws = FieldType.of((group.quotient(2), 1))
        return nn.Sequential(EquivariantConv2d(regular, yaws, 1, gain=gain))
    hidden, value = (FieldType.of((group.trivial, count)) for count in (HEAD_CHANNELS, 1))
    return nn.Sequential(
        EquivariantConv2d(regular, hidden, 3, padding=1),
        nn.ReLU(inplace=True),
        EquivariantConv2d(hidden, value, 1, gain=gain),
    )


def coefficient_layer(dynamic: DynamicEquivariantConv2d, features: int) -> nn.Linear:
    """
    Return a layer from a number of features to the coefficients of a dynamic filter.

    The initial bias is a random filter, because a filter near zero would learn slowly.
    """
    layer = nn.Linear(features, dynamic.num_coefficients)
    nn.init.normal_(layer.bias)
    with th.no_grad():
        layer.bias[-dynamic.space.num_biases :] = 0.0
    return layer


def of_primitive(values: th.Tensor, places: th.Tensor) -> th.Tensor:
    """
    Return the values of the next primitive, (batch, ...), float32.

    :param values: values of pick and place, (batch, 2, ...)
    :param places: whether the next primitive is a place, bool (batch,)
    """
    samples = th.arange(len(values), device=values.device)
    return values[samples, places.long()].float()
