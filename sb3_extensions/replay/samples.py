"""What a replay buffer hands out."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

from sb3_extensions.replay.frames import Ids


class FrameReplayBufferSamples(NamedTuple):
    """
    Stable-Baselines3's ``(Dict)ReplayBufferSamples``, and what demonstrations and prioritized replay add.

    All tensors but the observations are of shape (batch, 1) or (batch, action dimensions). ``dones`` is 1
    only where the episode terminated: a timeout bootstraps. ``discounts`` multiplies the value of
    ``next_observations``; it is None where the buffer was given no ``gamma``. ``is_expert`` is boolean,
    ``weights`` are importance weights, ``indices`` (numpy, shape (batch,)) the rows of the table.
    ``expert_actions`` are what an expert wanted, or would have wanted, NaN where none was asked. ``returns``
    are the discounted rewards to the end of the episode or up to the next exploratory action, NaN while the
    episode goes on or where there is no ``gamma``.
    """

    observations: TensorDict | th.Tensor
    actions: th.Tensor
    next_observations: TensorDict | th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    is_expert: th.Tensor
    weights: th.Tensor
    indices: Ids
    expert_actions: th.Tensor
    returns: th.Tensor
