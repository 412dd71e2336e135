"""Features extractor for observations of numbers, for any Stable-Baselines3 algorithm."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_extensions.common.observations import IMAGE_AXES, as_parts, space_parts
from sb3_extensions.encoders.observation import check_standardise


class MlpExtractor(BaseFeaturesExtractor):
    """Fully connected encoder with layer normalisation, for observations such as poses instead of images.

    :param observation_space: Dict of Boxes, flattened in the order of the Dict, or one Box; no images
    :param layers: units of each layer; the output of the last layer is the features
    :param standardise: (mean, standard deviation): numbers become (number - mean) / standard deviation. For
        metres, (0.0, 0.1) gives tenths of a metre. ``None`` leaves the numbers unchanged
    :raises ValueError: if there are images or spaces other than Boxes, or an argument is invalid
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        layers: Sequence[int] = (256, 256),
        standardise: Sequence[float] | None = None,
    ) -> None:
        if not layers or min(layers) < 1:
            raise ValueError(f"layers must be positive numbers of units, at least one, got {layers}")
        check_standardise("standardise", standardise)
        parts = space_parts(observation_space)
        for key, space in parts.items():
            if not isinstance(space, spaces.Box) or len(space.shape) == IMAGE_AXES:
                raise ValueError(
                    f"observation_space must have Boxes of numbers, no images: {key!r} is {space}"
                )
        super().__init__(observation_space, layers[-1])
        # An observation may have another order than its space.
        self.keys = list(parts)
        self.mean, self.std = (0.0, 1.0) if standardise is None else standardise
        n_numbers = get_flattened_obs_dim(observation_space)
        # With layer normalisation the imitation error after as many updates is several times smaller.
        self.encoder = nn.Sequential(
            *create_mlp(n_numbers, -1, list(layers), post_linear_modules=[nn.LayerNorm])
        )

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        parts = as_parts(observations)
        numbers = th.cat([parts[key].flatten(1) for key in self.keys], dim=1)
        features: th.Tensor = self.encoder((numbers - self.mean) / self.std)
        return features
