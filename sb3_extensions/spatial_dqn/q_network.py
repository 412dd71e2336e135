"""Q function over the action grid, in one level or in several levels that choose one after the other."""

from collections.abc import Sequence

import torch as th
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_extensions.encoders.cnn import check_autocast, precision
from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.spatial_dqn.asr_heads import Level
from sb3_extensions.spatial_dqn.codec import PIXEL, SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import PixelMaps


class SpatialQNetwork(nn.Module):
    """
    Values of the actions on the grid.

    The first level values all pixels, for one yaw or all yaws. Each further level values one more number of
    the action, given the previous ones.

    :param codec: conversion of the actions to the grid
    :param scene_view: conversion of the observations
    :param pixel_maps: first level
    :param levels: further levels, in the order of the indices
    :param autocast: ``"bf16"`` for bfloat16 if the device supports it, ``None`` for float32
    :raises ValueError: if the levels do not choose each index of the codec once and in order
    """

    def __init__(
        self,
        codec: SpatialActionCodec,
        scene_view: SceneView,
        pixel_maps: PixelMaps,
        levels: Sequence[Level] = (),
        autocast: str | None = None,
    ) -> None:
        super().__init__()
        covered = [*(["theta"] if pixel_maps.rotations > 1 else []), *(level.name for level in levels)]
        if covered != list(codec.grids):
            raise ValueError(
                f"action_sequence={codec.action_sequence!r} needs levels for {list(codec.grids)} after the "
                f"pixel, got levels for {covered}"
            )
        check_autocast(autocast)
        self.codec, self.scene_view = codec, scene_view
        self.pixel_maps, self.levels = pixel_maps, nn.ModuleList(levels)
        self.autocast = autocast
        self._n_first = len(PIXEL) + (pixel_maps.rotations > 1)  # indices that the first level chooses
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def values(self, observations: TensorDict, indices: th.Tensor) -> list[th.Tensor]:
        """
        Return the values of all choices at every level, given the choices of the previous levels.

        :param observations: a batch
        :param indices: indices of the actions, int64 (batch, indices)
        :return: (batch, choices) for each level, float32
        """
        with precision(self.autocast, indices.device.type):
            view = self.scene_view(observations)
            maps, encoding = self.pixel_maps(view)
            further = [
                level(view, encoding, indices[:, : self._n_first + index])
                for index, level in enumerate(self.levels)
            ]
        return [maps.flatten(1), *further]

    def choices(self, indices: th.Tensor) -> list[th.Tensor]:
        """Return the choices (batch,) of actions at every level, from their indices (batch, indices)."""
        size = self.codec.size
        pixels = indices[:, 0] * size + indices[:, 1]
        if self.pixel_maps.rotations > 1:
            pixels = pixels + indices[:, 2] * size**2
        return [pixels, *indices[:, self._n_first :].unbind(1)]

    @th.no_grad()
    def greedy(self, observations: TensorDict) -> tuple[th.Tensor, th.Tensor]:
        """Return the best indices, int64 (batch, indices), and their values at the last level, (batch,)."""
        view = self.scene_view(observations)
        with precision(self.autocast, view.image.device.type):
            maps, encoding = self.pixel_maps(view)
            values, best = maps.flatten(1).max(dim=1)
            size = self.codec.size
            pixel = best % size**2
            first = [pixel // size, pixel % size, best // size**2]
            indices = th.stack(first[: self._n_first], dim=1)
            for level in self.levels:
                values, best = level(view, encoding, indices).max(dim=1)
                indices = th.cat([indices, best[:, None]], dim=1)
        return indices, values
