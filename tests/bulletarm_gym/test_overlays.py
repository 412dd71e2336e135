"""Rectangles over a heightmap."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from bulletarm_gym.geometry import Rectangle
from bulletarm_gym.observations.rasterizer import Window, rectangle_mask

EXTENT, CENTRE = 0.45, (0.45, 0.0)
RESOLUTION = EXTENT / 128


def inside(rectangle: Rectangle, size: int) -> NDArray[np.bool_]:
    x, y, length, width, yaw = rectangle
    steps = (np.arange(size) + 0.5) * (EXTENT / size) - EXTENT / 2
    dx, dy = CENTRE[0] + steps[:, None] - x, CENTRE[1] + steps[None, :] - y
    along, across = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
    return (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)


def random_rectangles(seed: int, count: int) -> list[Rectangle]:
    rng = np.random.default_rng(seed)
    rows = rng.uniform((0.25, -0.2, 0.005, 0.005, -4.0), (0.65, 0.2, 0.2, 0.2, 4.0), (count, 5))
    return [Rectangle(*row) for row in rows]


@pytest.mark.parametrize("size", [15, 64, 128])
def test_mask_has_the_pixels_inside_any_rectangle(size: int) -> None:
    window, rectangles = Window(CENTRE, EXTENT, size), random_rectangles(0, 50)
    masks = [inside(rectangle, size) for rectangle in rectangles]
    for rectangle, expected in zip(rectangles, masks, strict=True):
        np.testing.assert_array_equal(rectangle_mask(window, [rectangle]), expected)
    np.testing.assert_array_equal(rectangle_mask(window, rectangles[:3]), np.logical_or.reduce(masks[:3]))


def test_edges_through_pixel_centres_belong_to_the_rectangle() -> None:
    side = 5 * RESOLUTION
    corner = (CENTRE[0] + RESOLUTION / 2, CENTRE[1] + RESOLUTION / 2)
    for quarter in range(4):
        rectangle = Rectangle(*corner, side - RESOLUTION, side + RESOLUTION, quarter * math.pi / 2)
        rows, columns = np.nonzero(rectangle_mask(Window(CENTRE, EXTENT, 128), [rectangle]))
        assert sorted([np.ptp(rows) + 1, np.ptp(columns) + 1]) == [5, 7]


def test_rectangle_outside_or_without_area_is_not_drawn() -> None:
    window = Window(CENTRE, EXTENT, 128)
    for numbers in ((9, 9, 0.1, 0.1, 0), (0.45, 0, 0, 0.1, 0), (math.nan, 0, 0.1, 0.1, 0)):
        assert not rectangle_mask(window, [Rectangle(*numbers)]).any()
    assert rectangle_mask(window, [Rectangle(0.45, 0, 5, 5, 0.3)]).all()
