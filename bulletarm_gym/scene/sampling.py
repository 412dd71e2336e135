"""Finding room for things, with a bound on how long is searched."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from bulletarm_gym.geometry import Footprint, PlacementError, Pose
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.surfaces.surface import Point

T = TypeVar("T")

GRASP_ROOM = (0.21, 0.07)
"""Length and width (m) that tasks keep free around a block for a gripper, the same for every arm."""

ATTEMPTS = 200
"""Positions tried for one item before the whole arrangement is begun anew."""
ARRANGEMENTS = 50
"""Arrangements tried before the workspace counts as too small."""


GRID = 7
"""Points a side among which room is looked for."""


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


def stand(scene: Scene, item: SceneObject, point: Point, rng: np.random.Generator, spread: float) -> None:
    """Stand an item on the ground at a point, turned by up to ``spread`` (rad) unless told not to."""
    yaw = float(rng.uniform(-spread, spread)) if scene.config.random_orientation else 0.0
    item.place(scene.surface.lay(item.spec, point, yaw))


def place_apart(
    scene: Scene,
    rng: np.random.Generator,
    items: Sequence[SceneObject],
    gap: float,
    spread: float = math.pi,
    taken: Sequence[Footprint] = (),
    allows: Callable[[Pose], bool] = lambda pose: True,
) -> None:
    """Lay items on the ground at random, so that their true footprints are apart and inside the border.

    What is in the scene besides them stays where it is, and they keep the same gap to it.

    :param gap: least distance (m) between two footprints
    :param spread: greatest yaw (rad) either way; 0 without ``random_orientation``
    :param taken: more footprints to keep the gap to
    :param allows: whether an item may lie at a pose
    :raises PlacementError: they do not fit together
    """
    others = [*taken, *footprints(scene, without=items)]
    largest_first = sorted(items, key=lambda item: -item.spec.planar_radius)
    for _ in range(ARRANGEMENTS):
        covered, poses = list(others), []
        for item in largest_first:
            pose = _free_pose(scene, rng, item, gap, spread, covered, allows)
            if pose is None:
                break
            poses.append(pose)
            covered.append(footprint(item, pose))
        else:
            for item, pose in zip(largest_first, poses, strict=True):
                item.place(pose)
            return
    raise PlacementError(
        f"workspace: found no room for {len(items)} items {gap:.3f} m apart in {scene.config.workspace[:2]}"
    )


def free_pose(
    scene: Scene, rng: np.random.Generator, item: SceneObject, gap: float, spread: float = math.pi
) -> Pose:
    """Draw a pose in which an item, held or not, can be put on the ground away from all others.

    :param gap: least distance (m) between footprints
    :param spread: greatest yaw (rad) either way; 0 without ``random_orientation``
    :raises PlacementError: there is no room for it
    """
    pose = _free_pose(scene, rng, item, gap, spread, footprints(scene, without=[item]))
    if pose is None:
        raise PlacementError(f"workspace: found no room for {item.slot.name} {gap:.3f} m from all others")
    return pose


def free_site(
    scene: Scene, rng: np.random.Generator, size: Point, gap: float, without: Sequence[SceneObject] = ()
) -> Pose:
    """Draw a place on level ground to build on, away from the items that lie there.

    :param size: width and length (m) of the base, along x and y of the frame returned
    :param gap: least distance (m) of the base to footprints
    :param without: items that do not count
    :return: frame of the site, level, its origin on the ground
    :raises PlacementError: there is no such place
    """
    covered = footprints(scene, without)
    spread = math.pi if scene.config.random_orientation else 0.0

    def is_free(site: Pose) -> bool:
        base = Footprint.rectangle(size, site)
        return all(base.gap(other) >= gap for other in covered)

    return sample_until(lambda: scene.surface.goal_site(size, rng, spread), is_free)


def footprint(item: SceneObject, pose: Pose | None = None) -> Footprint:
    """Return what an item covers of the ground, where it is or would be at a pose."""
    return Footprint.of(item.spec.mesh.vertices, pose) if pose else item.cached_by_pose(_shadow)


def _shadow(item: SceneObject) -> Footprint:
    return Footprint.of(item.spec.mesh.vertices, item.pose)


def footprints(scene: Scene, without: Sequence[SceneObject] = ()) -> list[Footprint]:
    """Return what the items of a scene cover: all but some, marks and what the gripper holds."""
    absent = [*without, scene.held]
    return [footprint(item) for item in scene if item not in absent and not item.spec.is_mark]


def _free_pose(
    scene: Scene,
    rng: np.random.Generator,
    item: SceneObject,
    gap: float,
    spread: float,
    covered: Sequence[Footprint],
    allows: Callable[[Pose], bool] = lambda pose: True,
) -> Pose | None:
    (x0, x1), (y0, y1), _ = scene.config.workspace
    for _ in range(ATTEMPTS):
        point = (float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1)))
        yaw = float(rng.uniform(-spread, spread)) if scene.config.random_orientation else 0.0
        pose = scene.surface.lay(item.spec, point, yaw)
        base = footprint(item, pose)
        free = scene.surface.fits(base, scene.surface.slide) and all(
            base.gap(other) >= gap for other in covered
        )
        if free and allows(pose):
            return pose
    return None


def most_free_point(scene: Scene, item: SceneObject) -> Point:
    """Return the point of the workspace that is farthest from all other items and not near the border."""
    margin = item.spec.planar_radius
    xs, ys = (np.linspace(low + margin, high - margin, GRID) for low, high in scene.config.workspace[:2])
    others = [other.pose.position[:2] for other in scene if other is not item]
    points = [(x, y) for x in xs.tolist() for y in ys.tolist()]
    return max(points, key=lambda point: min((math.dist(point, other) for other in others), default=0.0))


def sample_until(draw: Callable[[], T], fits: Callable[[T], bool], attempts: int = ATTEMPTS) -> T:
    """Draw until something fits.

    :raises PlacementError: nothing did
    """
    for _ in range(attempts):
        drawn = draw()
        if fits(drawn):
            return drawn
    raise PlacementError(f"workspace: found no room for what the task needs, in {attempts} attempts")


def is_within(scene: Scene, point: Sequence[float], margin: float) -> bool:
    """Whether a point is at least ``margin`` (m) inside the workspace's border in x and y."""
    limits = scene.config.workspace[:2]
    return all(
        low + margin <= value <= high - margin for value, (low, high) in zip(point, limits, strict=False)
    )
