"""Exploration of SACfD in addition to the sampling of its policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise

from sb3_extensions.common.exploration import replace_one_number
from sb3_extensions.common.seeds import SeedKey, derive_seed
from sb3_extensions.demonstrations.off_policy import OffPolicyFromDemonstrations
from sb3_extensions.replay.buffer import EXPLORED


class Exploration(OffPolicyFromDemonstrations):
    """
    Random replacement of numbers of actions, and episodes of deterministic actions.

    Deterministic policies get stuck in states that sampled actions leave. Episodes of deterministic actions
    put these states into the replay buffer.

    A subclass precedes an algorithm of Stable-Baselines3 in the bases. Its constructor sets the attributes.

    - ``exploration``: probability of a replacement, see
      :func:`~sb3_extensions.common.exploration.replace_one_number`
    - ``deterministic_fraction``: probability that an episode has deterministic actions
    - ``exploration_generator``: random generator on the CPU
    """

    exploration: float
    deterministic_fraction: float
    exploration_generator: th.Generator
    _is_deterministic: npt.NDArray[np.bool_] | None = None
    """Whether the present episode of each environment has deterministic actions."""

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        action, sampled = super()._sample_action(learning_starts, action_noise, n_envs)
        buffer_action = sampled
        if self.exploration > 0:
            buffer_action = replace_one_number(sampled, self.exploration, self.exploration_generator)
        self._explored = (buffer_action != sampled).any(axis=1)
        if self.deterministic_fraction > 0 and self.num_timesteps >= learning_starts:
            deterministic = self._sample_deterministic(n_envs)
            buffer_action = np.where(deterministic[:, None], self._deterministic_actions(), buffer_action)
            self._explored &= ~deterministic
        if buffer_action is sampled:
            return action, sampled
        return self.policy.unscale_action(buffer_action), buffer_action

    def _sample_deterministic(self, n_envs: int) -> npt.NDArray[np.bool_]:
        """Return which environments act deterministically; sampled at the start of an episode."""
        sampled = th.rand(n_envs, generator=self.exploration_generator).numpy() < self.deterministic_fraction
        if self._is_deterministic is None or self._last_episode_starts is None:
            self._is_deterministic = sampled
        else:
            self._is_deterministic = np.where(self._last_episode_starts, sampled, self._is_deterministic)
        return self._is_deterministic

    def _deterministic_actions(self) -> npt.NDArray[Any]:
        assert self._last_obs is not None
        actions, _ = self.predict(self._last_obs, deterministic=True)
        scaled: npt.NDArray[Any] = self.policy.scale_action(actions)
        return scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: npt.NDArray[Any],
        new_obs: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        reward: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        annotated = [
            {**info, EXPLORED: flag} for info, flag in zip(infos, self._explored.tolist(), strict=True)
        ]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, annotated)
        self._last_episode_starts = dones  # SB3's off-policy algorithms leave it as reset() set it

    def _seed_samplers(self, seed: int | None) -> None:
        super()._seed_samplers(seed)
        if seed is not None:
            self.exploration_generator.manual_seed(derive_seed(seed, SeedKey.EXPLORATION))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "exploration_generator", "_explored"]
