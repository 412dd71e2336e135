"""Exploratory actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

EXPLORED_HEIGHT = 0.01
"""Minimum height (m) of pixels with objects to pick (the authors' code)."""


def replace_one_number(
    actions: npt.NDArray[Any], probability: float, generator: th.Generator
) -> npt.NDArray[Any]:
    """
    Replace one random number of some actions by a uniform sample from [-1, 1].

    The other numbers do not change, so that for example the gripper opens at the intended position.

    :param actions: in the policy's units [-1, 1], shape (n, action dimensions)
    :param probability: probability that an action is changed
    :param generator: random generator on the CPU
    :return: actions of the same shape and type
    """
    n, action_dim = actions.shape
    changed = th.rand(n, generator=generator) < probability
    chosen = th.randint(action_dim, (n,), generator=generator)
    sampled = th.rand(n, 1, generator=generator) * 2 - 1
    replaced = changed[:, None] & (chosen[:, None] == th.arange(action_dim))
    return np.where(replaced, sampled, actions).astype(actions.dtype)


def explore_on_grid(
    indices: npt.NDArray[np.int64],
    heights: npt.NDArray[Any],
    probability: float,
    shape: Sequence[int],
    generator: th.Generator,
) -> npt.NDArray[np.int64]:
    """
    Replace some actions on a grid by random ones.

    The pixel is sampled from the pixels higher than :data:`EXPLORED_HEIGHT`, if the image has any.

    :param indices: row, column and further indices, (n, indices)
    :param heights: heightmaps in m, (n, size, size)
    :param probability: probability that an action is replaced
    :param shape: number of values of each index
    :param generator: random generator on the CPU
    :return: (n, indices)
    """
    replaced = th.rand(len(indices), generator=generator) < probability
    sampled = th.stack([th.randint(count, (len(indices),), generator=generator) for count in shape], dim=1)
    shares = th.rand(len(indices), generator=generator, dtype=th.float64).numpy()
    for index, (image, share) in enumerate(zip(heights, shares, strict=True)):
        high = np.argwhere(image > EXPLORED_HEIGHT)
        if len(high):
            sampled[index, :2] = th.from_numpy(high[int(share * len(high))])
    return np.where(replaced[:, None], sampled, indices)
