"""Exploration beyond the noise of a policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

# Lower pixels, m, show nothing that a gripper could take (the authors' code).
EXPLORED_HEIGHT = 0.01


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
