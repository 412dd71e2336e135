"""Encoders of point clouds, whose features do not depend on the order of the points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_extensions.common.images import is_point_cloud

HIDDEN = 64
"""Units of the layer before the features."""


def point_clouds(parts: Mapping[str, gym.Space[Any]]) -> dict[str, spaces.Box]:
    """Spaces of the point clouds of an observation, in the order of its parts."""
    return {
        key: space
        for key, space in parts.items()
        if isinstance(space, spaces.Box) and is_point_cloud(space.shape)
    }


class PointEncoder(nn.Module):
    """Features of a point cloud: one small network for each point, and of each of its numbers the largest
    (PointNet, https://arxiv.org/abs/1612.00593).

    :param features_dim: number of features
    :param invariant: look at the points' distances from the z axis and their heights alone, which stay as
        they are when the scene turns about that axis or is mirrored
    """

    def __init__(self, features_dim: int, invariant: bool = False) -> None:
        super().__init__()
        self.invariant = invariant
        layers = create_mlp(
            2 if invariant else 3, -1, [HIDDEN, features_dim], post_linear_modules=[nn.LayerNorm]
        )
        self.network = nn.Sequential(*layers)

    def forward(self, points: th.Tensor) -> th.Tensor:
        """
        :param points: (batch, points, 3)
        :return: (batch, features_dim)
        """
        if self.invariant:
            points = th.cat([points[..., :2].norm(dim=-1, keepdim=True), points[..., 2:]], dim=-1)
        features: th.Tensor = self.network(points).amax(dim=1)
        return features


class PointClouds(nn.Module):
    """Features of the point clouds of an observation, each with an encoder of its own; there may be none.

    :param observation_space: Dict, or a Box that has none
    :param features: number of features of each
    :param invariant: see :class:`PointEncoder`
    """

    def __init__(self, observation_space: gym.Space[Any], features: int, invariant: bool) -> None:
        super().__init__()
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {}
        self.encoders = nn.ModuleDict({key: PointEncoder(features, invariant) for key in point_clouds(parts)})
        self.features_dim = features * len(self.encoders)

    def forward(self, observations: TensorDict) -> list[th.Tensor]:
        """:return: of each cloud (batch, features)"""
        return [encoder(observations[key]) for key, encoder in self.encoders.items()]
