"""Networks that choose what follows a pixel: yaw, height and tilts of the gripper (ASR,
https://arxiv.org/abs/2010.02798).

Each gives the values of one more number of the action, given those before it: of a view, the encoding of the
scene, and the indices so far, (batch, numbers), to (batch, values of the number).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.cnn import HalvingMaxPool, Stage, resize
from sb3_extensions.encoders.initialisation import OUTPUT_GAIN, initialise_xavier, scale_down
from sb3_extensions.encoders.observation import SceneView, View
from sb3_extensions.encoders.patch_encoders import PatchMap, PatchVector, mlp
from sb3_extensions.equivariant.convolution import apply_in_float32
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import DynamicEquivariantConv2d, EquivariantConv2d
from sb3_extensions.spatial_dqn.codec import PIXEL, SpatialActionCodec
from sb3_extensions.spatial_dqn.patches import crop_patches
from sb3_extensions.spatial_dqn.pixel_maps import PRIMITIVES, Shapes, coefficients_of, of_primitive
from sb3_extensions.spatial_dqn.projections import orthographic_projections, rotation_matrices

PROJECTIONS = 3  # along the gripper's axes
PATCH_SIZE = 24  # of the authors' code, pixels, where there is no in-hand image to say it
SMALL_PATCH_SIDE = 3  # of the last map of the 6D networks

# Ways of patches to one pixel, by their side: those of 24 and 40 pixels are the authors'.
PATCH_STAGES = {
    12: (Stage(5, padding=1), Stage(5, padding=1, pools=True), Stage(3, padding=0), Stage(2, padding=0)),
    16: (
        Stage(5, padding=1),
        Stage(5, padding=1, pools=True),
        Stage(3, padding=0, pools=False),
        Stage(3, padding=1, pools=True),
        Stage(2, padding=0),
    ),
    24: (
        Stage(7, padding=2),
        Stage(7, padding=2, pools=True),
        Stage(7, padding=2),
        Stage(3, padding=0, pools=True),
        Stage(3, padding=0),
    ),
    40: (
        Stage(7, padding=3, pools=True),
        Stage(7, padding=3, pools=True),
        Stage(7, padding=2),
        Stage(3, padding=0, pools=True),
        Stage(3, padding=0),
    ),
}


class Level(nn.Module):
    """
    What they have in common.

    :param codec: the grid
    :param name: of the number that it values
    :param shapes: of the images
    """

    def __init__(self, codec: SpatialActionCodec, name: str, shapes: Shapes) -> None:
        super().__init__()
        self.codec, self.name = codec, name
        self.choices = len(codec.grids[name])
        self.in_hand_channels = 0 if shapes.in_hand is None else shapes.in_hand[0]
        self.patch_size = PATCH_SIZE if shapes.in_hand is None else shapes.in_hand[1]

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """
        :param view: what is seen
        :param encoding: of the scene
        :param indices: row, column and what follows them so far, int64 (batch, numbers)
        :return: (batch, values of the number)
        """
        raise NotImplementedError

    def patch(self, view: View, indices: th.Tensor, angles: th.Tensor | None = None) -> th.Tensor:
        """The heightmap around the pixel, beside the in-hand image, (batch, channels, side, side)."""
        patch = crop_patches(view.image, indices[:, 0], indices[:, 1], self.patch_size, angles)
        return patch if view.in_hand is None else th.cat([patch, view.in_hand], dim=1)

    def chosen(self, name: str, indices: th.Tensor) -> th.Tensor:
        """Value of a number that is chosen already, m or rad, (batch,); 0 where the action has it not yet."""
        names = list(self.codec.grids)
        place = names.index(name) + len(PIXEL) if name in names else indices.shape[1]
        if place >= indices.shape[1]:
            return th.zeros(len(indices), device=indices.device)
        return self.grid(name, indices.device)[indices[:, place]]

    def grid(self, name: str, device: th.device) -> th.Tensor:
        """All values of a number, m or rad."""
        return th.as_tensor(self.codec.grids[name], dtype=th.float32, device=device)


class PlainRotations(Level):
    """
    Yaws from the patch around the pixel, the in-hand image and the encoding of the scene, all flattened.

    :param codec: the grid
    :param shapes: of the images
    :param encoding_shape: (channels, side, side)
    :param channels: of the three convolutions on the patch
    :param hidden: units of the hidden layer
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        shapes: Shapes,
        encoding_shape: tuple[int, int, int],
        channels: Sequence[int],
        hidden: int,
    ) -> None:
        super().__init__(codec, "theta", shapes)
        self.encoder = PatchMap(1 + self.in_hand_channels, channels)
        features = channels[-1] * PatchMap.side(self.patch_size) ** 2 + math.prod(encoding_shape)
        self.head = nn.Sequential(*mlp(features, [hidden]), nn.Linear(hidden, PRIMITIVES * self.choices))
        initialise_head(self.head)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, yaws)"""
        features = self.encoder(self.patch(view, indices)).flatten(1)
        hidden = self.head[:-1](th.cat([features, encoding.flatten(1)], dim=1))
        values = apply_in_float32(self.head[-1], hidden)
        return of_primitive(values.unflatten(1, (PRIMITIVES, self.choices)), view.places)


class EquivariantRotations(Level):
    """
    Yaws that shift when the patch turns: of C_2n for n yaws, with a filter whose coefficients come from the
    encoding of the scene and the in-hand image.

    :param codec: the grid
    :param shapes: of the images. Patches are resized to the next side of 12, 16, 24 or 40 pixels
    :param encoding_shape: (channels, side, side)
    :param fields: regular fields of each convolution on the patch
    :param in_hand_channels: of the convolutions on the in-hand image
    :param hidden: units of the two linear layers behind each, the encoding and the in-hand image
    :param pool_encoding: take the greatest value of each channel of the encoding over its pixels: then yaws
        also shift when the whole scene turns by a right angle. Otherwise all of it, as the authors' code
    :raises ValueError: if ``fields`` has another length than the stages for patches of this size
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        shapes: Shapes,
        encoding_shape: tuple[int, int, int],
        fields: Sequence[int],
        in_hand_channels: Sequence[int],
        hidden: Sequence[int],
        pool_encoding: bool = False,
    ) -> None:
        super().__init__(codec, "theta", shapes)
        self.encoded_size = min(
            (size for size in PATCH_STAGES if size >= self.patch_size), default=max(PATCH_STAGES)
        )
        stages = PATCH_STAGES[self.encoded_size]
        if len(stages) != len(fields):
            raise ValueError(
                f"patch_fields must have {len(stages)} entries for patches of {self.patch_size} pixels, "
                f"got {fields}"
            )
        self.pool_encoding = pool_encoding
        group = Group("cyclic", 2 * self.choices)
        types = [FieldType.of((group.trivial, 1)), *(FieldType.of((group.regular, n)) for n in fields)]
        layers: list[nn.Module] = []
        for in_type, out_type, stage in zip(types, types[1:], stages, strict=False):
            layers.append(EquivariantConv2d(in_type, out_type, stage.kernel_size, padding=stage.padding))
            layers += [HalvingMaxPool()] if stage.pools else []
            layers.append(nn.ReLU(inplace=True))
        self.encoder = nn.Sequential(*layers)
        self.dynamic = DynamicEquivariantConv2d(types[-1], types[-1], 1)
        scene_features = encoding_shape[0] if pool_encoding else math.prod(encoding_shape)
        self.scene = nn.Sequential(*mlp(scene_features, hidden))
        self.scene.apply(initialise_xavier)
        self.in_hand: PatchVector | None = None
        if shapes.in_hand is not None:
            self.in_hand = PatchVector(shapes.in_hand[0], shapes.in_hand[1], in_hand_channels, hidden)
        features = hidden[-1] * (1 if self.in_hand is None else 2)
        self.coefficients = coefficients_of(self.dynamic, features)
        yaws = FieldType.of((group.quotient(2), PRIMITIVES))
        self.head = EquivariantConv2d(types[-1], yaws, 1, gain=OUTPUT_GAIN)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, yaws)"""
        patch = crop_patches(view.image, indices[:, 0], indices[:, 1], self.patch_size)
        features = self.encoder(resize(patch, self.encoded_size))
        scene = encoding.amax(dim=(2, 3)) if self.pool_encoding else encoding.flatten(1)
        condition = self.scene(scene)
        if self.in_hand is not None:
            condition = th.cat([condition, self.in_hand(view.in_hand)], dim=1)
        features = F.relu(self.dynamic(features, self.coefficients(condition)))
        values = apply_in_float32(self.head, features).flatten(1).unflatten(1, (PRIMITIVES, self.choices))
        return of_primitive(values, view.places)


class Widths(NamedTuple):
    """
    Of the networks on patches in 6D.

    :param channels: of the convolutions
    :param hidden: units of the two linear layers behind them, and behind the encoding's
    """

    channels: tuple[int, ...] = (32, 64, 128, 128)
    hidden: tuple[int, ...] = (1024, 512)

    def encoder(self, in_channels: int, size: int) -> PatchVector:
        """
        Make the network on a patch.

        :param in_channels: of the patch
        :param size: its side, pixels
        """
        return PatchVector(in_channels, size, self.channels, self.hidden, SMALL_PATCH_SIDE)


class PlainLevel(Level):
    """
    Any number behind the pixel, from the encoding of the scene and a patch: for yaw and height the heightmap
    around the pixel, for height turned by the yaw; for the tilts what is around the gripper as it is chosen
    so far, projected along its three axes (the authors' code).

    :param codec: the grid
    :param name: of the number
    :param shapes: of the images
    :param encoding_shape: (channels, side, side)
    :param widths: of the layers
    :param scene_view: standardises projections as it does images
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        name: str,
        shapes: Shapes,
        encoding_shape: tuple[int, int, int],
        widths: Widths,
        scene_view: SceneView,
    ) -> None:
        super().__init__(codec, name, shapes)
        self.projects = name in ("phi", "psi")
        self._standardised = scene_view.standardised
        in_channels = (PROJECTIONS if self.projects else 1) + self.in_hand_channels
        self.encoder = widths.encoder(in_channels, self.patch_size)
        channels, side, _ = encoding_shape
        narrow = max(1, channels // 2)
        self.scene = nn.Sequential(
            nn.Conv2d(channels, narrow, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(2, ceil_mode=True),
            nn.Flatten(),
            *mlp(narrow * (-(-side // 2)) ** 2, widths.hidden),
        )
        self.scene.apply(initialise_xavier)
        self.head = nn.Linear(2 * widths.hidden[-1], PRIMITIVES * self.choices)
        scale_down(self.head)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, values of the number)"""
        features = th.cat([self.encoder(self._seen(view, indices)), self.scene(encoding)], dim=1)
        values = apply_in_float32(self.head, features).unflatten(1, (PRIMITIVES, self.choices))
        return of_primitive(values, view.places)

    def _seen(self, view: View, indices: th.Tensor) -> th.Tensor:
        if not self.projects:
            return self.patch(view, indices, self.chosen("theta", indices) if self.name == "z" else None)
        z, *angles = (self.chosen(name, indices)[:, None] for name in ("z", "theta", "phi", "psi"))
        projections = self._standardised(project_around(self, view, indices, z, angles))[:, 0]
        return projections if view.in_hand is None else th.cat([projections, view.in_hand], dim=1)


class DeicticLevel(Level):
    """
    Any number behind the yaw: what would be around the gripper is projected along its axes for each value of
    the number, and each is valued alone, beside the in-hand image (https://arxiv.org/abs/2110.15443).

    :param codec: the grid
    :param name: of the number
    :param shapes: of the images
    :param widths: of the layers
    :param scene_view: standardises projections as it does images
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        name: str,
        shapes: Shapes,
        widths: Widths,
        scene_view: SceneView,
    ) -> None:
        super().__init__(codec, name, shapes)
        self._standardised = scene_view.standardised
        in_channels = PROJECTIONS + self.in_hand_channels
        self.encoder = widths.encoder(in_channels, self.patch_size)
        self.head = nn.Linear(widths.hidden[-1], PRIMITIVES)
        scale_down(self.head)

    def forward(self, view: View, encoding: th.Tensor, indices: th.Tensor) -> th.Tensor:
        """:return: (batch, values of the number)"""
        candidates = self.grid(self.name, indices.device)[None]
        z, *angles = (
            candidates if name == self.name else self.chosen(name, indices)[:, None]
            for name in ("z", "theta", "phi", "psi")
        )
        seen = self._standardised(project_around(self, view, indices, z, angles))
        if view.in_hand is not None:
            in_hand = view.in_hand[:, None].expand(-1, self.choices, -1, -1, -1)
            seen = th.cat([seen, in_hand], dim=2)
        values = apply_in_float32(self.head, self.encoder(seen.flatten(0, 1)))
        values = values.unflatten(0, (-1, self.choices))
        return of_primitive(values.transpose(1, 2), view.places)


def project_around(
    level: Level, view: View, indices: th.Tensor, z: th.Tensor, angles: Sequence[th.Tensor]
) -> th.Tensor:
    """
    What is around the gripper in poses over a chosen pixel, along its three axes.

    :param level: whose grid and patch size it is
    :param view: what is seen
    :param indices: begin with row and column
    :param z: heights, m, (batch or 1, candidates or 1)
    :param angles: theta, phi, psi, rad, likewise
    :return: m, (batch, candidates, 3, side, side)
    """
    z, *angles = th.broadcast_tensors(z, *angles)
    rotations = rotation_matrices(*angles)
    size, resolution = level.patch_size, level.codec.resolution
    return orthographic_projections(
        view.heights, indices[:, 0], indices[:, 1], z, rotations, size, resolution
    )


def initialise_head(head: nn.Sequential) -> None:
    """
    Xavier weights, the last layer small.

    :param head: linear layers
    """
    head.apply(initialise_xavier)
    last = head[-1]
    assert isinstance(last, nn.Linear)
    scale_down(last)
