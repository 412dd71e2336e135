"""Finding room for things, with a bound on how long is searched."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from bulletarm_gym.geometry import Pose
from bulletarm_gym.scene import Item, Scene
from bulletarm_gym.surfaces.surface import Point

T = TypeVar("T")

ATTEMPTS = 200
"""Positions tried for one item before the whole arrangement is begun anew."""
ARRANGEMENTS = 50
"""Arrangements tried before the workspace counts as too small."""


GRID = 7
"""Points a side among which room is looked for."""


class PlacementError(RuntimeError):
    """No arrangement was found; the workspace is too small for what it should hold."""


def scatter(
    scene: Scene,
    rng: np.random.Generator,
    margins: Sequence[float],
    gap: float,
    aligned: bool = False,
) -> list[Point]:
    """Draw positions in the workspace, uniformly among those far enough from its border and from each other.

    :param margins: of each position to the border (m)
    :param gap: least distance between two positions (m)
    :param aligned: all positions share their x, drawn once
    :return: (x, y) of each
    :raises PlacementError: they do not fit together
    :raises ValueError: the workspace is narrower than twice a margin
    """
    for _ in range(ARRANGEMENTS):
        points: list[Point] = []
        for margin in margins:
            line = points[0][0] if aligned and points else None
            point = _free_point(scene, rng, margin, gap, points, line)
            if point is None:
                break
            points.append(point)
        else:
            return points
    raise PlacementError(
        f"workspace: found no room for {len(margins)} items {gap:.3f} m apart in {scene.config.workspace[:2]}"
    )


def _free_point(
    scene: Scene,
    rng: np.random.Generator,
    margin: float,
    gap: float,
    taken: Sequence[Point],
    line: float | None,
) -> Point | None:
    for _ in range(ATTEMPTS):
        x, y = scene.surface.sample_position(rng, margin)
        point = (x if line is None else line, y)
        if all(math.dist(point, other) >= gap for other in taken):
            return point
    return None


def stand(scene: Scene, item: Item, point: Point, rng: np.random.Generator, spread: float) -> None:
    """Stand an item on the ground at a point, turned by up to ``spread`` (rad) unless told not to."""
    yaw = float(rng.uniform(-spread, spread)) if scene.config.random_orientation else 0.0
    lift = item.spec.extents[2] / 2.0
    item.place(scene.surface.pose(point, yaw).compose(Pose((0.0, 0.0, lift))))


def roomiest(scene: Scene, item: Item) -> Point:
    """Return the point of the workspace that is farthest from all other items and not near the border."""
    margin = item.spec.footprint
    xs, ys = (np.linspace(low + margin, high - margin, GRID) for low, high in scene.config.workspace[:2])
    others = [other.pose.position[:2] for other in scene if other is not item]
    points = [(x, y) for x in xs.tolist() for y in ys.tolist()]
    return max(points, key=lambda point: min((math.dist(point, other) for other in others), default=0.0))


def draw_until(draw: Callable[[], T], fits: Callable[[T], bool]) -> T:
    """Draw until something fits.

    :raises PlacementError: nothing did
    """
    for _ in range(ATTEMPTS):
        drawn = draw()
        if fits(drawn):
            return drawn
    raise PlacementError(f"workspace: nothing fitted in {ATTEMPTS} attempts")


def is_within(scene: Scene, point: Sequence[float], margin: float) -> bool:
    """Whether a point is at least ``margin`` (m) inside the workspace's border in x and y."""
    limits = scene.config.workspace[:2]
    return all(
        low + margin <= value <= high - margin for value, (low, high) in zip(point, limits, strict=False)
    )
