"""Exploration beyond the noise of a policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th


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
