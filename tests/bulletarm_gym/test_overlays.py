"""Rectangles drawn over a heightmap."""

import math

import numpy as np
import pytest

from bulletarm_gym.geometry import Rectangle
from bulletarm_gym.observations.rasterizer import Window, rectangle_mask

EXTENT, SIZE = 0.45, 128
RESOLUTION = EXTENT / SIZE
CENTRE = (0.45, 0.0)


def inside(rectangle, centre=CENTRE, size=SIZE):
    x, y, length, width, yaw = rectangle
    steps = (np.arange(size) + 0.5) * (EXTENT / size) - EXTENT / 2
    dx, dy = centre[0] + steps[:, None] - x, centre[1] + steps[None, :] - y
    along, across = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
    return (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)


def random_rectangles(rng, count):
    columns = [rng.uniform(0.25, 0.65, count), rng.uniform(-0.2, 0.2, count)]
    columns += [rng.uniform(0.005, 0.2, count), rng.uniform(0.005, 0.2, count), rng.uniform(-4, 4, count)]
    return [Rectangle(*row) for row in np.stack(columns, axis=1)]


@pytest.mark.parametrize("size", [15, 64, 128])
def test_mask_holds_the_pixels_inside(size: int) -> None:
    for rectangle in random_rectangles(np.random.default_rng(0), 50):
        mask = rectangle_mask(Window(CENTRE, EXTENT, size), [rectangle])
        assert mask.dtype == np.bool_
        np.testing.assert_array_equal(mask, inside(rectangle, size=size))


def test_mask_of_several_rectangles_is_their_union() -> None:
    rectangles = random_rectangles(np.random.default_rng(1), 3)
    covered = np.logical_or.reduce([inside(r) for r in rectangles])
    np.testing.assert_array_equal(rectangle_mask(Window(CENTRE, EXTENT, SIZE), rectangles), covered)


def test_edges_through_pixel_centres_belong_to_the_rectangle() -> None:
    side = 5 * RESOLUTION
    corner = (CENTRE[0] + RESOLUTION / 2, CENTRE[1] + RESOLUTION / 2)
    for quarter in range(4):
        rectangle = Rectangle(*corner, side - RESOLUTION, side + RESOLUTION, quarter * math.pi / 2)
        rows, columns = np.nonzero(rectangle_mask(Window(CENTRE, EXTENT, SIZE), [rectangle]))
        assert sorted([np.ptp(rows) + 1, np.ptp(columns) + 1]) == [5, 7]


@pytest.mark.parametrize("size", [64, 75, 128])
def test_quarter_turn_of_the_world_is_rot90(size: int) -> None:
    rng = np.random.default_rng(2)
    rectangles = random_rectangles(rng, 20)
    side = 6 * RESOLUTION
    rectangles[:5] = [Rectangle(0.45 + k * RESOLUTION, 0.0, side, side, 0.0) for k in range(5)]
    for before in rectangles:
        after = before._replace(x=-before.y, y=before.x, yaw=before.yaw + math.pi / 2)
        mask = rectangle_mask(Window(CENTRE, EXTENT, size), [before])
        again = rectangle_mask(Window((-CENTRE[1], CENTRE[0]), EXTENT, size), [after])
        np.testing.assert_array_equal(again, np.rot90(mask, k=1))


def test_what_lies_outside_or_covers_nothing_is_not_drawn() -> None:
    nothing = [
        Rectangle(9, 9, 0.1, 0.1, 0),
        Rectangle(0.45, 0, 0, 0.1, 0),
        Rectangle(math.nan, 0, 0.1, 0.1, 0),
        Rectangle(0.45, 0, 0.1, 0.1, math.nan),
    ]
    assert not rectangle_mask(Window(CENTRE, EXTENT, SIZE), nothing).any()
    assert not rectangle_mask(Window(CENTRE, EXTENT, SIZE), ()).any()
    assert rectangle_mask(Window(CENTRE, EXTENT, SIZE), [Rectangle(0.45, 0, 5, 5, 0.3)]).all()
