"""Finding room for things, with a bound on how long is searched."""

import math
from collections.abc import Sequence

import numpy as np

from bulletarm_gym.scene import Scene

ATTEMPTS = 200
"""Positions tried for one item before the whole arrangement is begun anew."""
ARRANGEMENTS = 50
"""Arrangements tried before the workspace counts as too small."""

Point = tuple[float, float]


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
    :raises PlacementError: the workspace is too small
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
    (x0, x1), (y0, y1), _ = scene.config.workspace
    if x1 - x0 < 2.0 * margin:
        return None
    for _ in range(ATTEMPTS):
        x, y = float(rng.uniform(x0 + margin, x1 - margin)), float(rng.uniform(y0 + margin, y1 - margin))
        point = (x if line is None else line, y)
        if all(math.dist(point, other) >= gap for other in taken):
            return point
    return None
