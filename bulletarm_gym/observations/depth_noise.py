"""Errors of depth cameras: noise, resolution, missing pixels and ragged edges."""

import zlib
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.simulation import Camera

HOLE = 4
"""Side (pixels) of the squares without a measurement."""
QUANTILES = 65536
"""Number of values of the normal noise. A table is faster than the generation of normal numbers."""

Depths = NDArray[np.float32]


class DepthNoise:
    """Errors of depth images, a function of sampled values, moment and camera.

    :param values: sampled values by key, see :class:`~bulletarm_gym.randomization.Randomization`
    :param moment: seed of the episode, number of steps, and other integers that identify the moment
    """

    def __init__(self, values: Mapping[str, float], moment: Sequence[int]) -> None:
        self._moment = tuple(moment)
        self._missing = values.get("depth_missing", 0.0)
        errors = (values.get(f"depth_{name}", 0.0) for name in ("noise", "step", "edges"))
        self._noise, self._step, self._edges = errors

    @property
    def is_off(self) -> bool:
        """Whether measured and true distances are equal."""
        return not (self._noise or self._step or self._missing or self._edges)

    def __call__(self, distances: NDArray[np.floating], camera: Camera | None = None) -> NDArray[np.floating]:
        """Return measured distances (height, width; m) for the true ones.

        :param camera: the camera; each camera has other errors at the same moment
        """
        if self.is_off:
            return distances
        rng = np.random.default_rng((*self._moment, zlib.crc32(repr(camera).encode())))
        rows, columns = distances.shape
        squares = (-(-rows // HOLE), -(-columns // HOLE))
        holes = rng.random(squares, np.float32) < self._missing
        random = rng.integers(2**32, size=distances.shape, dtype=np.uint32)
        depths = np.asarray(distances, np.float32)
        return _measure(depths, random, holes, _normal_quantiles(), self._noise, self._step, self._edges)


NO_NOISE = DepthNoise({}, ())
"""Depth images without errors."""


@cache
def _normal_quantiles() -> Depths:
    """Return equally probable values of the standard normal distribution, (QUANTILES,)."""
    quantiles: Depths = ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES).astype(np.float32)
    return quantiles


@compiled
def _measure(
    depths: Depths,
    random: NDArray[np.uint32],
    holes: NDArray[np.bool_],
    quantiles: Depths,
    noise: float,
    step: float,
    edges: float,
) -> Depths:
    """Return measured depths (m); see :class:`~bulletarm_gym.randomization.Randomization` for the errors.

    :param random: (rows, columns) random numbers of 32 bits: 16 for the adjacent pixel, 16 for the noise
    :param holes: squares without a measurement
    """
    rows, columns = depths.shape
    measured, limit, deviation = np.empty_like(depths), np.int64(edges * QUANTILES), np.float32(noise)
    for row in range(rows):
        for column in range(columns):
            number, depth = random[row, column], depths[row, column]
            chance = np.int64(number >> 16)
            if chance < limit:
                change, along = 2 * ((chance >> 1) & 1) - 1, chance & 1
                side = min(max(column + change * (1 - along), 0), columns - 1)
                depth = depths[min(max(row + change * along, 0), rows - 1), side]
            measured[row, column] = depth + deviation * depth * depth * quantiles[number & (QUANTILES - 1)]
    if step > 0.0:
        # Cameras measure disparities, the inverse of distances, at even steps (Khoshelham 2012).
        measured = (1.0 / (np.maximum(np.rint(1.0 / (step * measured)), 1.0) * step)).astype(np.float32)
    for row, square in np.argwhere(holes):
        for line in range(HOLE * row, min(HOLE * (row + 1), rows)):
            for column in range(max(HOLE * square, 1), min(HOLE * (square + 1), columns)):
                measured[line, column] = measured[line, column - 1]
    return measured
