"""Sampling of free points, poses and sites in the workspace, with a bounded number of attempts."""

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TypeVar

import numpy as np

from bulletarm_gym.geometry import Footprint, PlacementError, Pose, planar_distance
from bulletarm_gym.scene import Scene, SceneObject, cached_by_pose
from bulletarm_gym.surfaces.surface import ATTEMPTS, Point

T = TypeVar("T")
P = TypeVar("P", bound=Sequence[float])

GRASP_AREA = (0.21, 0.07)
"""Length and width (m) of the area around a block that tasks keep free for any gripper."""
ARRANGEMENTS = 50
"""Number of arrangements before the workspace counts as too small."""
GRID = 7
"""Number of candidate points along each side of the workspace for the most free point."""


class _AttemptsExhausted(PlacementError):
    """No sample fits."""


def sample_until(draw: Callable[[], T], fits: Callable[[T], bool], attempts: int = ATTEMPTS) -> T:
    """Return the first sample that fits.

    :raises PlacementError: none of ``attempts`` samples fits
    """
    for _ in range(attempts):
        sample = draw()
        if fits(sample):
            return sample
    raise _AttemptsExhausted(f"workspace: found no room for the task in {attempts} attempts")


def _sample_all(scene: Scene, count: int, gap: float, sample: Callable[[list[T]], T]) -> list[T]:
    """Return samples that depend on the samples before them; start again where one does not fit."""
    for _ in range(ARRANGEMENTS):
        samples: list[T] = []
        with suppress(_AttemptsExhausted):
            while len(samples) < count:
                samples.append(sample(samples))
            return samples
    limits = scene.config.workspace[:2]
    raise PlacementError(f"workspace: found no room for {count} objects {gap:.3f} m apart in {limits}")


def scatter(
    scene: Scene, rng: np.random.Generator, margins: Sequence[float], gap: float, aligned: bool = False
) -> list[Point]:
    """Sample points of the workspace, uniformly among those with enough distance.

    :param margins: distance (m) of each point to the border
    :param gap: smallest distance (m) between two points
    :param aligned: all points have the same x
    :return: (x, y) of each
    :raises PlacementError: the points do not fit together
    """

    def sample(points: list[Point]) -> Point:
        def draw() -> Point:
            x, y = scene.surface.sample_position(rng, margins[len(points)])
            return (points[0][0] if aligned and points else x, y)

        return sample_until(draw, lambda point: all(math.dist(point, other) >= gap for other in points))

    return _sample_all(scene, len(margins), gap, sample)


def random_yaw(scene: Scene, rng: np.random.Generator, spread: float) -> float:
    """Sample a yaw (rad) in +-``spread``; it is 0 without ``random_orientation``."""
    return float(rng.uniform(-spread, spread)) if scene.config.random_orientation else 0.0


def goal_site(scene: Scene, rng: np.random.Generator, size: Point) -> Pose:
    """Sample a level frame for a base of ``size`` (m); its yaw is 0 without ``random_orientation``.

    :raises PlacementError: no such place exists
    """
    return scene.surface.goal_site(size, rng, math.pi if scene.config.random_orientation else 0.0)


def stand(scene: Scene, obj: SceneObject, point: Point, rng: np.random.Generator, spread: float) -> None:
    """Place an object on the surface at a point, with a random yaw in +-``spread`` (rad)."""
    obj.place(scene.surface.lay(obj.spec, point, random_yaw(scene, rng, spread)))


def place_apart(
    scene: Scene,
    rng: np.random.Generator,
    objects: Sequence[SceneObject],
    gap: float,
    allows: Callable[[Pose], bool] = lambda pose: True,
) -> None:
    """Place objects on the surface at random, their footprints apart and inside the border.

    All other objects of the scene stay where they are and keep the same gap.

    :param gap: smallest distance (m) between two footprints
    :param allows: returns False for poses that are excluded
    :raises PlacementError: the objects do not fit together
    """
    largest_first = sorted(objects, key=lambda obj: -obj.spec.planar_radius)
    others = footprints(scene, without=objects)

    def sample(poses: list[Pose]) -> Pose:
        placed = zip(largest_first, poses, strict=False)
        covered = [*others, *(footprint(obj, pose) for obj, pose in placed)]
        return free_pose(scene, rng, largest_first[len(poses)], gap, covered, allows)

    for obj, pose in zip(largest_first, _sample_all(scene, len(objects), gap, sample), strict=True):
        obj.place(pose)


def free_pose(
    scene: Scene,
    rng: np.random.Generator,
    obj: SceneObject,
    gap: float,
    covered: Sequence[Footprint] | None = None,
    allows: Callable[[Pose], bool] = lambda pose: True,
) -> Pose:
    """Sample a pose of an object on the surface.

    :param gap: smallest distance (m) between footprints
    :param covered: footprints to avoid, by default those of all other objects
    :param allows: returns False for poses that are excluded
    :raises PlacementError: no sample fits
    """
    (x0, x1), (y0, y1), _ = scene.config.workspace
    others = footprints(scene, without=[obj]) if covered is None else covered

    def draw() -> Pose:
        point = (float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1)))
        return scene.surface.lay(obj.spec, point, random_yaw(scene, rng, math.pi))

    def fits(pose: Pose) -> bool:
        base = footprint(obj, pose)
        inside = scene.surface.fits(base, scene.surface.slide)
        return inside and base.gap(*others) >= gap and allows(pose)

    return sample_until(draw, fits)


def free_site(
    scene: Scene, rng: np.random.Generator, size: Point, gap: float, without: Sequence[SceneObject] = ()
) -> Pose:
    """Sample a level site to build on, away from the objects of the scene.

    :param size: width and length (m) of the base, along x and y of the returned frame
    :param gap: smallest distance (m) of the base to footprints
    :param without: objects to ignore
    :return: level frame of the site, its origin on the surface
    :raises PlacementError: no such place exists
    """
    covered = footprints(scene, without)

    def is_free(site: Pose) -> bool:
        base = Footprint.rectangle(size, site)
        return base.gap(*covered) >= gap

    return sample_until(lambda: goal_site(scene, rng, size), is_free)


def footprint(obj: SceneObject, pose: Pose | None = None) -> Footprint:
    """Return the footprint of an object at its present pose or at another pose."""
    return Footprint.of(obj.spec.mesh.vertices, pose) if pose else _present_footprint(obj)


@cached_by_pose
def _present_footprint(obj: SceneObject) -> Footprint:
    return Footprint.of(obj.spec.mesh.vertices, obj.pose)


def footprints(scene: Scene, without: Sequence[SceneObject] = ()) -> list[Footprint]:
    """Return the footprints of all objects except some, marks and the grasped object."""
    absent = [*without, scene.held]
    return [footprint(obj) for obj in scene if obj not in absent and not obj.spec.is_mark]


def most_free_point(scene: Scene, obj: SceneObject) -> Point:
    """Return the point on a grid in the workspace with the largest distance to all other objects."""
    margin = obj.spec.planar_radius
    xs, ys = (np.linspace(low + margin, high - margin, GRID) for low, high in scene.config.workspace[:2])
    points = [(x, y) for x in xs.tolist() for y in ys.tolist()]
    return most_free(points, [other for other in scene if other is not obj])


def most_free(points: Iterable[P], others: Sequence[SceneObject]) -> P:
    """Return the point (m) with the largest horizontal distance to the nearest of other objects."""
    positions = [other.pose.position for other in others]
    return max(points, key=lambda point: min((planar_distance(point, p) for p in positions), default=0.0))


def is_within(scene: Scene, point: Sequence[float], margin: float) -> bool:
    """Return True if a point is at least ``margin`` (m) inside the workspace's border in x and y."""
    limits = scene.config.workspace[:2]
    return all(
        low + margin <= value <= high - margin for value, (low, high) in zip(point, limits, strict=False)
    )
