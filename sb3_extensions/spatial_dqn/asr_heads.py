"""Networks of yaw, height and tilts, which are chosen after the pixel (ASR, https://arxiv.org/abs/2010.02798)."""

import math
from collections.abc import Mapping, Sequence

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.cnn import Stage, resize, stack_stages
from sb3_extensions.encoders.initialisation import initialise_output, initialise_xavier
from sb3_extensions.encoders.observation import SceneView, View
from sb3_extensions.encoders.patch_encoders import PatchMap, PatchVector
from sb3_extensions.equivariant.convolution import apply_in_float32
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import DynamicEquivariantConv2d, EquivariantConv2d
from sb3_extensions.spatial_dqn.codec import PIXEL, SpatialActionCodec
from sb3_extensions.spatial_dqn.patches import crop_patches
from sb3_extensions.spatial_dqn.pixel_maps import PRIMITIVES, coefficient_layer, of_primitive
from sb3_extensions.spatial_dqn.projections import orthographic_projections, rotation_matrices

PROJECTIONS = 3
"""Number of projections, one along each axis of the gripper."""
PATCH_SIZE = 24
"""Side (pixels) of patches without an in-hand image (the authors' code)."""
SMALL_PATCH_SIDE = 3
"""Maximum side (pixels) of the last map of the 6D networks."""
PATCH_CHANNELS, PATCH_HIDDEN = (32, 64, 128, 128), (1024, 512)
"""Channels and units of the 6D networks (the authors' code)."""

PATCH_STAGES = {
    12: (Stage(5, 1, 1), Stage(5, 1, 1, True), Stage(3, 1, 0), Stage(2, 1, 0)),
    16: (Stage(5, 1, 1), Stage(5, 1, 1, True), Stage(3, 1, 0), Stage(3, 1, 1, True), Stage(2, 1, 0)),
    24: (Stage(7, 1, 2), Stage(7, 1, 2, True), Stage(7, 1, 2), Stage(3, 1, 0, True), Stage(3, 1, 0)),
    40: (Stage(7, 1, 3, True), Stage(7, 1, 3, True), Stage(7, 1, 2), Stage(3, 1, 0, True), Stage(3, 1, 0)),
}
"""Stages from a patch of each side (pixels) to one pixel; 24 and 40 pixels are the authors'."""


class Level(nn.Module):
    """
    Base class of the networks: values of one number of the action, given the previous ones.

    :param codec: conversion of the actions to the grid
    :param name: name of the number
    :param scene_view: conversion of the observations
    """

    def __init__(self, codec: SpatialActionCodec, name: str, scene_view: SceneView) -> None:
        super().__init__()
        self.codec, self.name = codec, name
        self.choices = len(codec.grids[name])
        self.in_hand_channels, self.patch_size = scene_view.in_hand_shape or (0, PATCH_SIZE)
        self.mean, self.std = scene_view.standardise
        self.scale = scene_view.patch_scale

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """
        :param view: batch of inputs
        :param encoding: encoding of the scene
        :param indices: row, column and the numbers chosen so far, int64 (batch, indices)
        :return: (batch, values of the number)
        """
        raise NotImplementedError

    def patch(self, view: View, indices: th.Tensor, angles: th.Tensor | None = None) -> th.Tensor:
        """Return the heightmap around the pixel and the in-hand image, (batch, channels, side, side)."""
        patch = self.scale * crop_patches(view.image, indices[:, 0], indices[:, 1], self.patch_size, angles)
        return patch if view.in_hand is None else th.cat([patch, view.in_hand], dim=1)

    def project(
        self, view: View, indices: th.Tensor, candidates: Mapping[str, th.Tensor] | None = None
    ) -> th.Tensor:
        """
        Return the scene around the gripper at the pixel, along its three axes, and the in-hand image.

        :param candidates: values of numbers that replace the chosen ones, m or rad, (1, candidates)
        :return: standardised, (batch * candidates, channels, side, side)
        """
        poses = dict(candidates or {})
        z, *angles = th.broadcast_tensors(
            *(poses.get(name, self.chosen(name, indices)[:, None]) for name in ("z", "theta", "phi", "psi"))
        )
        pixel, rotations = (indices[:, 0], indices[:, 1]), rotation_matrices(*angles)
        projections = orthographic_projections(
            view.heights, *pixel, z, rotations, self.patch_size, self.codec.resolution
        )
        images = self.scale * (projections - self.mean) / self.std
        if view.in_hand is not None:
            in_hand = view.in_hand[:, None].expand(-1, images.shape[1], -1, -1, -1)
            images = th.cat([images, in_hand], dim=2)
        return images.flatten(0, 1)

    def chosen(self, name: str, indices: th.Tensor) -> th.Tensor:
        """Return the value of a number, m or rad, (batch,); 0 if it is not chosen yet."""
        names = list(self.codec.grids)
        column = names.index(name) + len(PIXEL) if name in names else indices.shape[1]
        if column >= indices.shape[1]:
            return th.zeros(len(indices), device=indices.device)
        return self.grid(name, indices.device)[indices[:, column]]

    def grid(self, name: str, device: th.device) -> th.Tensor:
        """Return all values of a number, m or rad."""
        return th.as_tensor(self.codec.grids[name], dtype=th.float32, device=device)

    def head_values(self, head: nn.Module, features: th.Tensor, view: View) -> th.Tensor:
        """Return the values of the next primitive from the output of the last layer, (batch, values)."""
        values = apply_in_float32(head, features).flatten(1).unflatten(1, (PRIMITIVES, self.choices))
        return of_primitive(values, view.places)


class PlainRotations(Level):
    """
    Values of yaws from the patch around the pixel, the in-hand image and the encoding of the scene.

    See :class:`Level` for the other parameters.

    :param encoding_shape: (channels, side, side)
    :param channels: channels of the three convolutions on the patch
    :param hidden: units of the hidden layer
    :param output_gain: factor of the initial weights of the last layer
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        scene_view: SceneView,
        encoding_shape: tuple[int, int, int],
        channels: Sequence[int],
        hidden: int,
        output_gain: float = 1.0,
    ) -> None:
        super().__init__(codec, "theta", scene_view)
        self.encoder = PatchMap(1 + self.in_hand_channels, channels)
        features = channels[-1] * PatchMap.side(self.patch_size) ** 2 + math.prod(encoding_shape)
        last = nn.Linear(hidden, PRIMITIVES * self.choices)
        self.head = nn.Sequential(*create_mlp(features, -1, [hidden]), last)
        self.head.apply(initialise_xavier)
        initialise_output(last, output_gain)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, yaws)"""
        features = self.encoder(self.patch(view, indices)).flatten(1)
        hidden = self.head[:-1](th.cat([features, encoding.flatten(1)], dim=1))
        return self.head_values(self.head[-1], hidden, view)


class EquivariantRotations(Level):
    """
    Values of n yaws that shift when the patch rotates (group C_2n).

    The coefficients of one filter come from the encoding of the scene and the in-hand image. Patches are
    resized to the next side of 12, 16, 24 or 40 pixels. See :class:`Level` for the other parameters.

    :param encoding_shape: (channels, side, side)
    :param fields: regular fields of each convolution on the patch
    :param in_hand_channels: channels of the convolutions on the in-hand image
    :param hidden: units of the two linear layers on each, the encoding and the in-hand image
    :param pool_encoding: use the maximum of each channel of the encoding over its pixels, so that yaws also
        shift when the whole scene rotates by 90 degrees. Otherwise use the whole encoding (the authors' code)
    :param output_gain: factor of the initial weights of the last layer
    :raises ValueError: if the number of ``fields`` is not the number of stages for patches of this size
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        scene_view: SceneView,
        encoding_shape: tuple[int, int, int],
        fields: Sequence[int],
        in_hand_channels: Sequence[int],
        hidden: Sequence[int],
        pool_encoding: bool = False,
        output_gain: float = 1.0,
    ) -> None:
        super().__init__(codec, "theta", scene_view)
        larger = (size for size in PATCH_STAGES if size >= self.patch_size)
        self.encoded_size = next(larger, max(PATCH_STAGES))
        stages = PATCH_STAGES[self.encoded_size]
        if len(stages) != len(fields):
            raise ValueError(
                f"patch_fields must have {len(stages)} entries for patches of {self.patch_size} pixels, "
                f"got {fields}"
            )
        self.pool_encoding = pool_encoding
        group = Group("cyclic", 2 * self.choices)
        types = [FieldType.of((group.trivial, 1)), *(FieldType.of((group.regular, n)) for n in fields)]
        self.encoder = stack_stages(EquivariantConv2d, types, stages)
        self.dynamic = DynamicEquivariantConv2d(types[-1], types[-1], 1)
        scene_features = encoding_shape[0] if pool_encoding else math.prod(encoding_shape)
        self.scene = nn.Sequential(*create_mlp(scene_features, -1, list(hidden)))
        self.scene.apply(initialise_xavier)
        self.in_hand: PatchVector | None = None
        if scene_view.in_hand_shape is not None:
            self.in_hand = PatchVector(*scene_view.in_hand_shape, in_hand_channels, hidden)
        features = hidden[-1] * (1 if self.in_hand is None else 2)
        self.coefficients = coefficient_layer(self.dynamic, features)
        yaws = FieldType.of((group.quotient(2), PRIMITIVES))
        self.head = EquivariantConv2d(types[-1], yaws, 1, gain=output_gain)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, yaws)"""
        patch = self.scale * crop_patches(view.image, indices[:, 0], indices[:, 1], self.patch_size)
        features = self.encoder(resize(patch, self.encoded_size))
        scene = encoding.amax(dim=(2, 3)) if self.pool_encoding else encoding.flatten(1)
        condition = self.scene(scene)
        if self.in_hand is not None:
            condition = th.cat([condition, self.in_hand(view.in_hand)], dim=1)
        features = F.relu(self.dynamic(features, self.coefficients(condition)))
        return self.head_values(self.head, features, view)


class PlainLevel(Level):
    """
    Values of one number from the encoding of the scene and a patch (the authors' code).

    The patch of yaw and height is the heightmap around the pixel, for the height rotated by the yaw. The
    patch of the tilts is the three projections around the gripper in the pose chosen so far. See
    :class:`Level` for the other parameters.

    :param encoding_shape: (channels, side, side)
    :param channels: channels of the convolutions on the patch
    :param hidden: units of the two linear layers on each, the patch and the encoding
    :param output_gain: factor of the initial weights of the last layer
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        name: str,
        scene_view: SceneView,
        encoding_shape: tuple[int, int, int],
        channels: Sequence[int] = PATCH_CHANNELS,
        hidden: Sequence[int] = PATCH_HIDDEN,
        output_gain: float = 1.0,
    ) -> None:
        super().__init__(codec, name, scene_view)
        self.projects = name in ("phi", "psi")
        in_channels = (PROJECTIONS if self.projects else 1) + self.in_hand_channels
        self.encoder = PatchVector(in_channels, self.patch_size, channels, hidden, SMALL_PATCH_SIDE)
        scene_channels, side, _ = encoding_shape
        narrow = max(1, scene_channels // 2)
        self.scene = nn.Sequential(
            nn.Conv2d(scene_channels, narrow, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2, ceil_mode=True),
            nn.Flatten(),
            *create_mlp(narrow * (-(-side // 2)) ** 2, -1, list(hidden)),
        )
        self.scene.apply(initialise_xavier)
        self.head = nn.Linear(2 * hidden[-1], PRIMITIVES * self.choices)
        initialise_output(self.head, output_gain)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, values of the number)"""
        features = th.cat([self.encoder(self.inputs(view, indices)), self.scene(encoding)], dim=1)
        return self.head_values(self.head, features, view)

    def inputs(self, view: View, indices: th.Tensor) -> th.Tensor:
        """Return the patch, (batch, channels, side, side)."""
        if self.projects:
            return self.project(view, indices)
        return self.patch(view, indices, self.chosen("theta", indices) if self.name == "z" else None)


class DeicticLevel(Level):
    """
    Values of one number after the yaw, each from its own projections and the in-hand image
    (https://arxiv.org/abs/2110.15443). See :class:`PlainLevel` for the parameters.
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        name: str,
        scene_view: SceneView,
        channels: Sequence[int] = PATCH_CHANNELS,
        hidden: Sequence[int] = PATCH_HIDDEN,
        output_gain: float = 1.0,
    ) -> None:
        super().__init__(codec, name, scene_view)
        in_channels = PROJECTIONS + self.in_hand_channels
        self.encoder = PatchVector(in_channels, self.patch_size, channels, hidden, SMALL_PATCH_SIDE)
        self.head = nn.Linear(hidden[-1], PRIMITIVES)
        initialise_output(self.head, output_gain)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, values of the number)"""
        candidates = {self.name: self.grid(self.name, indices.device)[None]}
        images = self.project(view, indices, candidates)
        values = apply_in_float32(self.head, self.encoder(images)).unflatten(0, (-1, self.choices))
        return of_primitive(values.transpose(1, 2), view.places)
