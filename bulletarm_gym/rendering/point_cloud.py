"""Heightmaps from a point cloud, as a real cell with two depth cameras makes them.

The paper's close-loop observation, Section Close-loop Environments.
"""

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.geometry.compilation import compiled

EMPTY = np.float32(-np.inf)


def project(
    points: FloatArray, centre: tuple[float, float], extent: float, size: int, ceiling: float
) -> NDArray[np.float32]:
    """Return the height of the highest point over every pixel.

    Pixels that no point fell into take the value of the nearest one that has some. Rows grow with world x,
    columns with y; pixel (i, j) covers ``extent / size`` of each.

    :param points: (n, 3) world coordinates (m)
    :param centre: world x and y of the middle of the image (m)
    :param extent: side of the square seen (m)
    :param size: pixels a side
    :param ceiling: points above this height (m) are left out
    :return: (size, size) float32 heights (m); zeros if no point falls into the square
    """
    cells = np.floor((points[:, :2] - (np.asarray(centre) - extent / 2.0)) * (size / extent)).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(axis=1) & (points[:, 2] <= ceiling)
    image = np.full((size, size), EMPTY, dtype=np.float32)
    np.maximum.at(image, tuple(cells[inside].T), points[inside, 2].astype(np.float32))
    if not inside.any():
        return np.zeros((size, size), dtype=np.float32)
    _fill(image)
    return image


@compiled
def _fill(image: NDArray[np.float32]) -> None:
    """Give empty pixels the value of the nearest filled one, of several the first in rows, then columns."""
    size = image.shape[0]
    source = image.copy()
    for i in range(size):
        for j in range(size):
            if source[i, j] == EMPTY:
                image[i, j] = _nearest(source, i, j, size)


@compiled
def _nearest(source: NDArray[np.float32], i: int, j: int, size: int) -> np.float32:
    best, value = size * size * 2, source[i, j]
    for radius in range(1, size):
        if radius * radius > best:
            break
        for row in range(max(i - radius, 0), min(i + radius, size - 1) + 1):
            step = 1 if abs(row - i) == radius else 2 * radius
            for column in range(j - radius, j + radius + 1, step):
                if 0 <= column < size and source[row, column] != EMPTY:
                    distance = (row - i) ** 2 + (column - j) ** 2
                    if distance < best:
                        best, value = distance, source[row, column]
    return value  # type: ignore[no-any-return]
