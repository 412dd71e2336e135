"""Samples of the replay buffer."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_extensions.replay.step_table import Rows


class ExpertReplayBufferSamples(NamedTuple):
    """
    Sampled steps: Stable-Baselines3's ``ReplayBufferSamples`` with additional fields for demonstrations.

    All tensors but the observations have shape (batch, 1) or (batch, action dimensions).

    - ``dones``: 1 if the target has no bootstrap
    - ``discounts``: factor of the value of ``next_observations``, None if the buffer has no ``gamma``
    - ``is_expert``: whether the step belongs to a demonstration
    - ``weights``: importance weights
    - ``indices``: rows of the table, NumPy array of shape (batch,)
    - ``expert_actions``: actions of the expert, NaN if unknown
    - ``succeeded``: whether the episode succeeded without an exploratory action after this step
    """

    observations: TensorDict | th.Tensor
    actions: th.Tensor
    next_observations: TensorDict | th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    is_expert: th.Tensor
    weights: th.Tensor
    indices: Rows
    expert_actions: th.Tensor
    succeeded: th.Tensor


def count_rows(observations: TensorDict | th.Tensor) -> int:
    """Return the batch size of observations."""
    first = next(iter(observations.values())) if isinstance(observations, dict) else observations
    return len(first)


def select_rows(observations: TensorDict | th.Tensor, rows: th.Tensor) -> TensorDict | th.Tensor:
    """Return the observations of ``rows``, indices of shape (n,)."""
    if isinstance(observations, th.Tensor):
        return observations[rows]
    return {key: values[rows] for key, values in observations.items()}


def compute_next_values(
    samples: ExpertReplayBufferSamples, compute: Callable[[TensorDict | th.Tensor], th.Tensor]
) -> th.Tensor:
    """
    Compute values of the next observations, only of those from which the target bootstraps.

    Most steps of sparse tasks with n-step returns end the episode.

    :param samples: sample of the replay buffer
    :param compute: function of observations that returns values, (rows, values)
    :return: shape (next observations, values), 0 without a bootstrap
    """
    n_next, continues = count_rows(samples.next_observations), samples.dones[: len(samples.indices), 0] == 0
    rows = continues.repeat(n_next // len(continues)).nonzero()[:, 0]
    if not len(rows):
        return samples.rewards.new_zeros(n_next, 1)
    values = compute(select_rows(samples.next_observations, rows))
    return values.new_zeros(n_next, values.shape[1]).index_put((rows,), values)
