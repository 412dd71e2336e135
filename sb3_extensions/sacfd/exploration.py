"""Exploration of SACfD beyond the noise of its policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.noise import ActionNoise

from sb3_extensions.common.exploration import disturb_one_number
from sb3_extensions.demonstrations.off_policy import OffPolicyFromDemonstrations
from sb3_extensions.replay.buffer import EXPLORED


class OneNumberExploration(OffPolicyFromDemonstrations):
    """
    Replaces one number of some actions, see :func:`disturb_one_number`, and tells the replay buffer which.

    A subclass stands before an algorithm of Stable-Baselines3, whose constructor sets the attributes.

    - ``exploration``: probability with which an action is disturbed
    - ``exploration_generator``: source of the randomness, on the CPU
    """

    exploration: float
    exploration_generator: th.Generator

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        action, chosen = super()._sample_action(learning_starts, action_noise, n_envs)
        if self.exploration == 0:
            self._explored = np.zeros(n_envs, dtype=bool)
            return action, chosen
        buffer_action = disturb_one_number(chosen, self.exploration, self.exploration_generator)
        self._explored = (buffer_action != chosen).any(axis=1)
        return self.policy.unscale_action(buffer_action), buffer_action

    def _annotated(self, infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
        told = super()._annotated(infos)
        return [{**info, EXPLORED: flag} for info, flag in zip(told, self._explored.tolist(), strict=True)]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "exploration_generator", "_explored"]
