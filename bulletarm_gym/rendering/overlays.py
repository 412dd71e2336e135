"""Shapes drawn over a heightmap: the gripper's two squares, a pushing goal.

A rectangle covers the pixels whose centre lies in it, edges included. Like the heightmap itself, what is
drawn turns with a scene turned by 90 degrees, bit for bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import Rectangle
from bulletarm_gym.rendering.rasterizer import draw_rectangles


@dataclass(frozen=True)
class Overlay:
    """A rectangle that the heightmap shows nearer the camera than what is there.

    :param rectangle: where
    :param rise: by how much it is nearer (m)
    """

    rectangle: Rectangle
    rise: float


def fill_rectangles(
    image: NDArray[np.float32],
    centre: tuple[float, float],
    extent: float,
    rectangles: Sequence[Rectangle],
    value: float,
) -> None:
    """Set in place the pixels that any of the rectangles covers.

    :param image: (size, size) float32
    :param centre: world x and y of the middle of the image (m)
    :param extent: side of the square seen (m)
    :param rectangles: what is filled
    :param value: the value to set
    """
    _draw(image, centre, extent, rectangles, np.float32(value))


def rectangle_mask(
    centre: tuple[float, float], extent: float, size: int, rectangles: Sequence[Rectangle]
) -> NDArray[np.bool_]:
    """Return which pixels any of the rectangles covers.

    :param centre: world x and y of the middle of the image (m)
    :param extent: side of the square seen (m)
    :param size: pixels a side
    :param rectangles: which may cover each other
    :return: (size, size) bool
    """
    mask = np.zeros((size, size), np.bool_)
    _draw(mask, centre, extent, rectangles, True)
    return mask


def _draw(
    image: NDArray[Any],
    centre: tuple[float, float],
    extent: float,
    rectangles: Sequence[Rectangle],
    value: Any,
) -> None:
    rows = np.array(rectangles, dtype=np.float64).reshape(len(rectangles), len(Rectangle._fields))
    draw_rectangles(image, rows, (float(centre[0]), float(centre[1]), float(extent)), value)
