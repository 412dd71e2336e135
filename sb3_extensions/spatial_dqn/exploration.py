"""Exploratory actions on the grid of a spatial Q algorithm."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_extensions.spatial_dqn.codec import Indices

EXPLORED_HEIGHT = 0.01
"""Minimum height (m) of pixels with objects to pick (the authors' code)."""


def explore_on_grid(
    indices: Indices,
    heights: npt.NDArray[Any],
    probability: float,
    shape: Sequence[int],
    generator: th.Generator,
) -> Indices:
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
