"""Errors in the execution of an expert's actions, which it then makes good."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_extensions.demonstrations.collecting import Actions


@dataclass(frozen=True)
class UnsteadyHand:
    """
    Carries actions out with a normal error, clipped to the bounds of the action space.

    Episodes then visit states that an agent will come to by its own errors, and show what the expert wants
    there: its wish, not the disturbed action, is what is to be imitated. DART: https://arxiv.org/abs/1703.09327

    :param action_space: of the environment
    :param noise: standard deviation of the error, in half the range of each number of an action
    :raises ValueError: if the noise is negative, or the space no Box
    """

    action_space: gym.Space[Actions]
    noise: float

    def __post_init__(self) -> None:
        if self.noise < 0.0:
            raise ValueError(f"noise must not be negative, got {self.noise}")
        if not isinstance(self.action_space, spaces.Box):
            raise ValueError(f"noise needs an action space with ranges, a Box, got {self.action_space}")

    def __call__(self, action: Actions, rng: np.random.Generator) -> Actions:
        """
        Carry an action out.

        :param action: what the expert wants, in the units of the environment
        :param rng: source of the error
        :return: what is done, of the space's type
        """
        space = self.action_space
        assert isinstance(space, spaces.Box)
        deviation = self.noise * (space.high - space.low) / 2.0
        done: Actions = np.clip(action + rng.normal(scale=deviation), space.low, space.high)
        return done.astype(space.dtype)
