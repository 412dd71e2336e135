"""Exploration beyond the noise of a policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_extensions.replay.buffer import EXPLORED

# Lower pixels, m, show nothing that a gripper could take (the authors' code).
EXPLORED_HEIGHT = 0.01


class OneNumberExploration(OffPolicyAlgorithm):
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

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: npt.NDArray[Any],
        new_obs: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        reward: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        told = [{**info, EXPLORED: flag} for info, flag in zip(infos, self._explored.tolist(), strict=True)]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, told)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "exploration_generator", "_explored"]


def disturb_one_number(
    actions: npt.NDArray[Any], probability: float, generator: th.Generator
) -> npt.NDArray[Any]:
    """
    Replace one number of some actions, any of them alike, by one drawn uniformly from its whole range.

    One number and not all: what the others do keeps its meaning. A gripper that opens where the hand is,
    is a trial; one that opens anywhere is an accident.

    :param actions: in the units of the policy, [-1, 1], shape (n, action dimensions)
    :param probability: with which an action is disturbed
    :param generator: source of the randomness, on the CPU
    :return: actions, of the same shape and type
    """
    n, action_dim = actions.shape
    disturbed = th.rand(n, generator=generator) < probability
    chosen = th.randint(action_dim, (n,), generator=generator)
    drawn = th.rand(n, 1, generator=generator) * 2 - 1
    replaced = disturbed[:, None] & (chosen[:, None] == th.arange(action_dim))
    return np.where(replaced, drawn, actions).astype(actions.dtype)


def explore_on_grid(
    indices: npt.NDArray[np.int64],
    heights: npt.NDArray[Any],
    probability: float,
    shape: Sequence[int],
    generator: th.Generator,
) -> npt.NDArray[np.int64]:
    """
    Replace some actions on a grid by random ones, where there is something in the heightmap if there is.

    :param indices: row, column and what follows them, (n, indices)
    :param heights: heightmaps, m, (n, size, size)
    :param probability: with which an action is replaced
    :param shape: number of values of each index
    :param generator: source of the randomness, on the CPU
    :return: (n, indices)
    """
    replaced = th.rand(len(indices), generator=generator) < probability
    drawn = th.stack([th.randint(count, (len(indices),), generator=generator) for count in shape], dim=1)
    shares = th.rand(len(indices), generator=generator, dtype=th.float64).numpy()
    for index, (image, share) in enumerate(zip(heights, shares, strict=True)):
        high = np.argwhere(image > EXPLORED_HEIGHT)
        if len(high):
            drawn[index, :2] = th.from_numpy(high[int(share * len(high))])
    return np.where(replaced[:, None], drawn, indices)
