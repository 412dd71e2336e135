"""A Q function over the grid of a codec, in one level or in several that choose one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager

import torch as th
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_extensions.encoders.cnn import check_autocast, precision
from sb3_extensions.encoders.observation import SceneView, View
from sb3_extensions.spatial_dqn.asr_heads import Level
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import PixelMaps


class SpatialQNetwork(nn.Module):
    """
    Values of actions on a grid. The first level values all pixels, of one yaw or all; every other one the
    values of one more number, given those before it.

    :param codec: the grid
    :param scene_view: what the networks see of an observation
    :param pixel_maps: the first level
    :param levels: the others, in the order of the codec's numbers
    :param autocast: ``"bf16"`` computes in bfloat16 where the device can, ``None`` in float32
    :param channels_last: keep the channels of a pixel together in memory
    :raises ValueError: if the levels do not choose each number of the codec once, in its order
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        scene_view: SceneView,
        pixel_maps: PixelMaps,
        levels: Sequence[Level] = (),
        autocast: str | None = None,
        channels_last: bool = True,
    ) -> None:
        super().__init__()
        covered = [*(["theta"] if pixel_maps.rotations > 1 else []), *(level.name for level in levels)]
        if covered != list(codec.grids):
            raise ValueError(
                f"the levels choose {covered} behind the pixel, the action sequence "
                f"{codec.action_sequence!r} needs {list(codec.grids)}"
            )
        check_autocast(autocast)
        self.codec, self.scene_view = codec, scene_view
        self.pixel_maps, self.levels = pixel_maps, nn.ModuleList(levels)
        self.autocast = autocast
        if channels_last:
            self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def values(self, observations: TensorDict, indices: th.Tensor) -> list[th.Tensor]:
        """
        Values of all choices at every level, given those that were made before it.

        :param observations: a batch
        :param indices: of the actions, int64 (batch, indices)
        :return: for each level (batch, choices), float32
        """
        with self._precision(indices.device):
            view = self.scene_view(observations)
            maps, encoding = self.pixel_maps(view)
            later = [
                level(view, encoding, indices[:, : self._known(place)])
                for place, level in enumerate(self.levels)
            ]
        return [maps.flatten(1), *later]

    def choices(self, indices: th.Tensor) -> list[th.Tensor]:
        """
        Which choice an action makes at every level.

        :param indices: int64 (batch, indices)
        :return: for each level (batch,)
        """
        size = self.codec.size
        row, column = indices[:, 0], indices[:, 1]
        pixels = row * size + column
        if self.pixel_maps.rotations > 1:
            pixels = pixels + indices[:, 2] * size**2
        return [pixels, *(indices[:, self._known(place)] for place in range(len(self.levels)))]

    @th.no_grad()
    def greedy(self, observations: TensorDict) -> tuple[th.Tensor, th.Tensor]:
        """
        The best choice at every level, one after the other.

        :param observations: a batch
        :return: indices, int64 (batch, indices), and the last level's values of them, (batch,)
        """
        view = self.scene_view(observations)
        with self._precision(view.image.device):
            maps, encoding = self.pixel_maps(view)
            values, best = maps.flatten(1).max(dim=1)
            indices = self._pixels(best)
            for level in self.levels:
                values, best = level(view, encoding, indices).max(dim=1)
                indices = th.cat([indices, best[:, None]], dim=1)
        return indices, values

    def maps(self, observations: TensorDict) -> th.Tensor:
        """
        Values of all pixels, for a look at them.

        :param observations: a batch
        :return: (batch, yaws, size, size), float32
        """
        view: View = self.scene_view(observations)
        with self._precision(view.image.device):
            values: th.Tensor = self.pixel_maps(view)[0]
        return values

    def _pixels(self, best: th.Tensor) -> th.Tensor:
        size = self.codec.size
        pixel = best % size**2
        places = [pixel // size, pixel % size]
        if self.pixel_maps.rotations > 1:
            places.append(best // size**2)
        return th.stack(places, dim=1)

    def _known(self, place: int) -> int:
        """How many indices are chosen before the level at a place behind the first."""
        return 2 + (self.pixel_maps.rotations > 1) + place

    def _precision(self, device: th.device) -> AbstractContextManager[object]:
        return precision(self.autocast, device.type)
