"""Samples of the replay buffer."""

from collections.abc import Callable
from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_extensions.common.observations import KEY, as_parts
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


def compute_next_values(
    samples: ExpertReplayBufferSamples, compute: Callable[[TensorDict | th.Tensor], th.Tensor]
) -> th.Tensor:
    """
    Compute values of the next observations, only of those from which the target bootstraps.

    :param samples: sample of the replay buffer
    :param compute: function of observations that returns values, (rows, values)
    :return: shape (next observations, values), 0 without a bootstrap
    """
    parts, continues = as_parts(samples.next_observations), samples.dones[: len(samples.indices), 0] == 0
    n_next = len(next(iter(parts.values())))
    rows = continues.repeat(n_next // len(continues)).nonzero()[:, 0]
    if not len(rows):
        return samples.rewards.new_zeros(n_next, 1)
    selected = {key: part[rows] for key, part in parts.items()}
    values = compute(selected if isinstance(samples.next_observations, dict) else selected[KEY])
    return values.new_zeros(n_next, values.shape[1]).index_put((rows,), values)
