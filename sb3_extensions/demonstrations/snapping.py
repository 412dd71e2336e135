"""An expert on a grid: what it shows are actions that a spatial Q network has a value for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_extensions.demonstrations.collecting import Actions, Hand

if TYPE_CHECKING:  # the codec's package imports this one
    from sb3_extensions.spatial_dqn.codec import SpatialActionCodec


@dataclass(frozen=True)
class SnappingHand:
    """
    Carries out the nearest actions on a grid.

    The expert sees what comes of them and goes on from there; only episodes that succeed so are kept.

    :param action_space: of the environment
    :param codec: the grid
    :param hand: what happens to the actions before, None: nothing
    :raises ValueError: if the space is no Box, or has no bounds
    """

    action_space: gym.Space[Actions]
    codec: SpatialActionCodec
    hand: Hand | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.action_space, spaces.Box) or not self.action_space.is_bounded():
            raise ValueError(f"a grid needs an action space with ranges, a Box, got {self.action_space}")

    def __call__(self, action: Actions, rng: np.random.Generator) -> Actions:
        """
        Carry an action out.

        :param action: what the expert wants, in the units of the environment
        :param rng: source of randomness of the hand before
        :return: what is done, of the space's type
        """
        space = self.action_space
        assert isinstance(space, spaces.Box)
        # In double precision, so that in a space from -1 to 1 it is the grid's number itself
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        wanted = np.clip(action if self.hand is None else self.hand(action, rng), low, high)
        snapped = self.codec.snap(2.0 * ((wanted - low) / (high - low))[None] - 1.0)[0]
        done: Actions = low + (snapped.astype(np.float64) + 1.0) / 2.0 * (high - low)
        return done.clip(low, high).astype(space.dtype)
