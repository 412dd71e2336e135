"""Features extractor for observations of numbers alone, for any Stable-Baselines3 algorithm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_extensions.common.images import IMAGE_AXES

KEY = "observation"
"""Of the only part where an observation is no Dict."""


class MlpExtractor(BaseFeaturesExtractor):
    """Fully connected encoder of an observation of numbers, such as poses instead of images; its layers are
    normalised.

    :param observation_space: Dict of Boxes, flattened in their order, or one Box; no images
    :param layers: units of each layer, the last one's are the features
    :param standardise: (mean, standard deviation) of the numbers: they become (number - mean) / standard
        deviation. Of metres, centimetres matter: (0.0, 0.1) makes them tenths. ``None`` takes them as they
        are
    :raises ValueError: if there are images or other spaces, no layers, or ``standardise`` is something else
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        layers: Sequence[int] = (256, 256),
        standardise: Sequence[float] | None = None,
    ) -> None:
        if not layers or min(layers) < 1:
            raise ValueError(f"layers must be positive numbers of units, at least one, got {layers}")
        if standardise is not None and not (len(standardise) == 2 and standardise[1] > 0.0):
            raise ValueError(f"standardise must be (mean, standard deviation above 0), got {standardise}")
        keys = _number_keys(observation_space)
        super().__init__(observation_space, layers[-1])
        self.keys = keys
        self.mean, self.std = (0.0, 1.0) if standardise is None else standardise
        n_numbers = get_flattened_obs_dim(observation_space)
        # Normalised layers imitate several times as exactly in as many updates.
        self.encoder = nn.Sequential(
            *create_mlp(n_numbers, -1, list(layers), post_linear_modules=[nn.LayerNorm])
        )

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        if isinstance(observations, th.Tensor):
            observations = {KEY: observations}
        numbers = th.cat([observations[key].flatten(1) for key in self.keys], dim=1)
        features: th.Tensor = self.encoder((numbers - self.mean) / self.std)
        return features


def _number_keys(observation_space: gym.Space[Any]) -> list[str]:
    """Names of the parts of an observation, in the space's order: an observation may have another."""
    parts: Mapping[str, gym.Space[Any]] = {KEY: observation_space}
    if isinstance(observation_space, spaces.Dict):
        parts = observation_space.spaces
    for key, space in parts.items():
        if not isinstance(space, spaces.Box) or len(space.shape) == IMAGE_AXES:
            raise ValueError(f"observation_space needs Boxes of numbers, no images: {key!r} is {space}")
    return list(parts)
