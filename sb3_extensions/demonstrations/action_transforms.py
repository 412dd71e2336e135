"""Transformations of the expert's actions before they are executed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # the package of the codec imports this one
    from sb3_extensions.spatial_dqn.codec import SpatialActionCodec

Actions = npt.NDArray[Any]
ActionTransform = Callable[[Actions, np.random.Generator], Actions]
"""Function from the intended action and a random generator to the executed action (environment's units)."""


@dataclass(frozen=True)
class GaussianExpertNoise:
    """
    Add Gaussian noise to actions, clipped to the bounds of the action space.

    The intended action is imitated, not the noisy one. Source: DART, https://arxiv.org/abs/1703.09327

    :param action_space: action space of the environment, a bounded Box
    :param std: standard deviation, in half the range of each number of an action
    """

    action_space: gym.Space[Actions]
    std: float

    def __call__(self, action: Actions, rng: np.random.Generator) -> Actions:
        """Return the noisy action."""
        space: Any = self.action_space
        noise = rng.normal(scale=self.std, size=space.shape) * (space.high - space.low) / 2
        noisy: Actions = np.clip(action + noise, space.low, space.high)
        return noisy.astype(space.dtype)


@dataclass(frozen=True)
class GridSnapping:
    """
    Move actions to the nearest cell of a grid.

    :param action_space: action space of the environment, a bounded Box
    :param codec: grid
    """

    action_space: gym.Space[Actions]
    codec: SpatialActionCodec

    def __call__(self, action: Actions, rng: np.random.Generator) -> Actions:
        """Return the action of the nearest cell."""
        space: Any = self.action_space
        # float64, so that the action of a cell is exact in a space from -1 to 1
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        snapped = self.codec.snap(2.0 * ((np.clip(action, low, high) - low) / (high - low))[None] - 1.0)[0]
        executed: Actions = low + (snapped.astype(np.float64) + 1.0) / 2.0 * (high - low)
        return executed.clip(low, high).astype(space.dtype)
