"""Heightmaps from point clouds (paper, Close-loop Environments)."""

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.geometry.compilation import compiled

EMPTY = np.float32(-np.inf)


def project(
    points: FloatArray, centre: tuple[float, float], extent: float, size: int, ceiling: float
) -> NDArray[np.float32]:
    """Return the height of the highest point over every pixel.

    A pixel without points gets the value of the nearest pixel with points.

    :param points: (n, 3) world coordinates (m)
    :param centre: world x and y of the image's centre (m)
    :param extent: side of the square shown (m)
    :param size: pixels a side
    :param ceiling: height (m) above which points are ignored
    :return: (size, size) heights (m), zeros if no point is in the square; rows grow with world x, columns
        with y
    """
    cells = np.floor((points[:, :2] - (np.asarray(centre) - extent / 2.0)) * (size / extent)).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(axis=1) & (points[:, 2] <= ceiling)
    if not inside.any():
        return np.zeros((size, size), dtype=np.float32)
    image = np.full((size, size), EMPTY, dtype=np.float32)
    np.maximum.at(image, tuple(cells[inside].T), points[inside, 2].astype(np.float32))
    _fill(image)
    return image


@compiled
def _fill(image: NDArray[np.float32]) -> None:
    """Set empty pixels to the value of the nearest filled one, the first in rows and columns of several."""
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
