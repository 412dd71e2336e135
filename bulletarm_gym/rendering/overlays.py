"""Shapes drawn over a heightmap: the gripper's two squares, a pushing goal.

A rectangle is a row of five numbers: world x and y of its centre, its length along its own x axis and its
width (m), its yaw (rad). It covers the pixels whose centre lies in it, edges included. Like the heightmap
itself, what is drawn turns with a scene turned by 90 degrees, bit for bit.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.rendering.rasterizer import draw_rectangles


@dataclass(frozen=True)
class Overlay:
    """A rectangle that the heightmap shows nearer the camera than what is there.

    :param rectangle: world x and y of its centre, length and width (m), yaw (rad)
    :param rise: by how much it is nearer (m)
    """

    rectangle: tuple[float, float, float, float, float]
    rise: float


def fill_rectangles(
    image: NDArray[np.float32],
    centre: tuple[float, float],
    extent: float,
    rectangles: ArrayLike,
    value: float,
) -> None:
    """Set in place the pixels that any of the rectangles covers.

    :param image: (size, size) float32
    :param centre: world x and y of the middle of the image (m)
    :param extent: side of the square seen (m)
    :param rectangles: (k, 5) x, y, length, width (m), yaw (rad)
    :param value: the value to set
    :raises ValueError: if ``rectangles`` is not of shape (k, 5)
    """
    _draw(image, centre, extent, rectangles, np.float32(value))


def rectangle_mask(
    centre: tuple[float, float], extent: float, size: int, rectangles: ArrayLike
) -> NDArray[np.bool_]:
    """Return which pixels any of the rectangles covers.

    :param centre: world x and y of the middle of the image (m)
    :param extent: side of the square seen (m)
    :param size: pixels a side
    :param rectangles: (k, 5) x, y, length, width (m), yaw (rad)
    :return: (size, size) bool
    :raises ValueError: if ``rectangles`` is not of shape (k, 5)
    """
    mask = np.zeros((size, size), np.bool_)
    _draw(mask, centre, extent, rectangles, True)
    return mask


def _draw(
    image: NDArray[Any], centre: tuple[float, float], extent: float, rectangles: ArrayLike, value: Any
) -> None:
    rows: FloatArray = np.ascontiguousarray(rectangles, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 5:
        raise ValueError(
            f"Rectangles are rows of x, y, length, width and yaw, not an array of shape {rows.shape}"
        )
    draw_rectangles(image, rows, (float(centre[0]), float(centre[1]), float(extent)), value)
