"""Exploration of SACfD beyond the noise of its policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise

from sb3_extensions.common.exploration import disturb_one_number
from sb3_extensions.common.seeds import SeedKey, derive_seed
from sb3_extensions.demonstrations.off_policy import OffPolicyFromDemonstrations
from sb3_extensions.replay.buffer import EXPLORED


class Exploration(OffPolicyFromDemonstrations):
    """
    Replaces one number of some actions, see :func:`disturb_one_number`, and tells the replay buffer which;
    and acts in some episodes as the trained agent will, without any randomness.

    What holds a deterministic agent for ever, a sampled action ends: without such episodes nobody sees that
    nothing is won there.

    A subclass stands before an algorithm of Stable-Baselines3, whose constructor sets the attributes.

    - ``exploration``: probability with which an action is disturbed
    - ``greedy_fraction``: probability with which an episode is one of deterministic actions
    - ``exploration_generator``: source of the randomness, on the CPU
    """

    exploration: float
    greedy_fraction: float
    exploration_generator: th.Generator
    _greedy: npt.NDArray[np.bool_] | None = None
    """Of each environment, whether its episode is one of deterministic actions."""

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        action, chosen = super()._sample_action(learning_starts, action_noise, n_envs)
        buffer_action = chosen
        if self.exploration > 0:
            buffer_action = disturb_one_number(chosen, self.exploration, self.exploration_generator)
        self._explored = (buffer_action != chosen).any(axis=1)
        if self.greedy_fraction > 0 and self.num_timesteps >= learning_starts:
            greedy = self._draw_greedy(n_envs)
            buffer_action = np.where(greedy[:, None], self._greedy_actions(), buffer_action)
            self._explored &= ~greedy
        if buffer_action is chosen:
            return action, chosen
        return self.policy.unscale_action(buffer_action), buffer_action

    def _draw_greedy(self, n_envs: int) -> npt.NDArray[np.bool_]:
        """Which environments are in an episode of deterministic actions; drawn when an episode begins."""
        drawn = th.rand(n_envs, generator=self.exploration_generator).numpy() < self.greedy_fraction
        if self._greedy is None or self._last_episode_starts is None:
            self._greedy = drawn
        else:
            self._greedy = np.where(self._last_episode_starts, drawn, self._greedy)
        return self._greedy

    def _greedy_actions(self) -> npt.NDArray[Any]:
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
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = dones  # SB3's off-policy algorithms leave it as reset() set it

    def _annotated(self, infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
        told = super()._annotated(infos)
        return [{**info, EXPLORED: flag} for info, flag in zip(told, self._explored.tolist(), strict=True)]

    def _seed_samplers(self, seed: int | None) -> None:
        super()._seed_samplers(seed)
        if seed is not None:
            self.exploration_generator.manual_seed(derive_seed(seed, SeedKey.EXPLORATION))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "exploration_generator", "_explored"]
