"""Exploration of SACfD in addition to the sampling of its policy."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise

from sb3_extensions.demonstrations.off_policy import OffPolicyFromDemonstrations
from sb3_extensions.replay.buffer import EXPLORED


def replace_one_number(
    actions: npt.NDArray[Any], probability: float, generator: th.Generator
) -> npt.NDArray[Any]:
    """
    Replace one random number of some actions by a uniform sample from [-1, 1].

    :param actions: in the policy's units [-1, 1], shape (n, action dimensions)
    :param probability: probability that an action is changed
    :param generator: random generator on the CPU
    """
    n, action_dim = actions.shape
    changed = th.rand(n, generator=generator) < probability
    chosen = th.randint(action_dim, (n,), generator=generator)
    sampled = th.rand(n, 1, generator=generator) * 2 - 1
    replaced = changed[:, None] & (chosen[:, None] == th.arange(action_dim))
    return np.where(replaced, sampled, actions).astype(actions.dtype)


class Exploration(OffPolicyFromDemonstrations):
    """Random replacement of numbers of actions, and episodes of deterministic actions."""

    exploration: float
    deterministic_fraction: float
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
            assert self._last_obs is not None
            greedy = self.policy.scale_action(self.predict(self._last_obs, deterministic=True)[0])
            buffer_action = np.where(deterministic[:, None], greedy, buffer_action)
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

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_explored"]
