"""Errors of depth cameras: noise, resolution, missing pixels and ragged edges."""

import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.simulation import Camera

HOLE = 4
"""Side (pixels) of the squares without a measurement."""
ERRORS = ("depth_noise", "depth_step", "depth_missing", "depth_edges")
"""Sampled quantities of the errors."""

Depths = NDArray[np.float32]

QUANTILES: Depths = ndtri((np.arange(4096) + 0.5) / 4096).astype(np.float32)
"""Equally probable values of the standard normal distribution; faster than generated normal numbers."""


def measured_depths(
    values: Mapping[str, float], seed: int, distances: NDArray[np.floating], camera: Camera | None = None
) -> Depths:
    """Return measured distances (height, width; m) for the true ones.

    :param values: sampled values by key, see :class:`~bulletarm_gym.randomization.Randomization`
    :param seed: integer from 0 to 2**63 - 1 that identifies the episode and the step
    :param camera: the camera; each camera has other errors with the same seed
    """
    errors = np.array([values.get(name, 0.0) for name in ERRORS], np.float32)
    number = zlib.crc32(repr(camera).encode())
    return _measure(np.asarray(distances, np.float32), seed, number, errors)


@compiled
def _random_bits(seed: np.uint64, number: int) -> np.uint64:
    """Return a number of the random sequence of a seed (SplitMix64, Steele et al. 2014)."""
    bits = seed + np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@compiled
def _measure(depths: Depths, seed: int, camera: int, errors: Depths) -> Depths:
    """Return measured depths (m) for the number of a camera and the values of :data:`ERRORS`."""
    rows, columns = depths.shape
    key = _random_bits(np.uint64(seed), camera)
    noise, step, missing, edges = errors[0], errors[1], errors[2] * 65536, errors[3] * 65536
    measured, one = np.empty_like(depths), np.float32(1.0)
    for row in range(rows):
        for column in range(columns):
            bits = np.int64(_random_bits(key, row * columns + column) >> np.uint64(1))
            above, left = np.int64(row), np.int64(column)
            if bits >> 47 < edges:  # the depth of the pixel above, below, left or right
                change = bits & 2
                above += (change - 1) * (bits & 1)
                left += (change - 1) * (1 - (bits & 1))
            depth = depths[min(max(above, 0), rows - 1), min(max(left, 0), columns - 1)]
            measured[row, column] = depth + noise * depth * depth * QUANTILES[(bits >> 2) & 4095]
    if step > 0.0:  # cameras measure disparities, the inverse of distances, at even steps
        measured = one / (np.maximum(np.rint(one / (step * measured)), one) * step)
    for top in range(0, rows, HOLE):
        for first in range(0, columns, HOLE):
            bits = np.int64(_random_bits(~key, top * columns + first) >> np.uint64(1))
            if bits >> 47 < missing:
                for row in range(top, min(top + HOLE, rows)):
                    measured[row, first : first + HOLE] = measured[row, max(first - 1, 0)]
    return measured
