"""How items stand to each other: the words that goals and experts are written in."""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.geometry import FloatArray, Footprint, matrix, planar_distance, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.surfaces.surface import Point

TOUCHING = 2e-3
"""Gap (m) up to which two items touch: what a collision leaves between them when they come to rest."""
UPRIGHT = math.pi / 9.0
"""Greatest tilt (rad) of what stands upright."""

IN_LINE = math.pi / 7.0
"""Greatest angle (rad) between a long block and the line through what it lies on."""


def touching(scene: Scene, first: SceneObject, second: SceneObject) -> bool:
    """Whether two items are in contact."""
    return scene.world.are_near(first.body, second.body, TOUCHING)


def is_held(scene: Scene, item: SceneObject) -> bool:
    """Whether the gripper holds an item."""
    return scene.robot.held is item.body


def is_empty(scene: Scene) -> bool:
    """Whether the gripper holds nothing."""
    return scene.robot.held is None


def at_rest(scene: Scene) -> bool:
    """Whether nothing moves."""
    return not scene.world.has_motion


def upright(item: SceneObject) -> bool:
    """Whether an item stands as it was made to stand."""
    return item.pose.tilt < UPRIGHT


def on_ground(scene: Scene, item: SceneObject) -> bool:
    """Whether an item touches the ground, level or not."""
    world = scene.world
    standing = (body for body in scene.surface.bodies if world.active[body.index])
    return any(world.are_near(item.body, body, TOUCHING) for body in standing)


def on_site(scene: Scene, item: SceneObject) -> bool:
    """Whether an item stands, all of it but a hair, on the level ground where structures are built."""
    level = abs(item.lowest - scene.surface.level) <= TOUCHING
    return level and scene.surface.fits_site(item.cached_by_pose(_all_but_a_hair))


def _all_but_a_hair(item: SceneObject) -> Footprint:
    return Footprint.of(item.spec.mesh.vertices, item.pose).grown(-TOUCHING)


def _rotation(item: SceneObject) -> FloatArray:
    return matrix(item.pose)


def carries(scene: Scene, bottom: SceneObject, top: SceneObject) -> bool:
    """Whether an item lies on another, if only with an end: higher by half its height, and in contact."""
    rise = top.pose.z - bottom.pose.z
    return rise >= min(bottom.spec.extents[2], top.spec.extents[2]) / 2.0 and touching(scene, bottom, top)


def on_top(scene: Scene, bottom: SceneObject, top: SceneObject) -> bool:
    """Whether an item lies on another: higher by half its height, in contact, its middle over the other."""
    reach = max(*bottom.spec.extents[:2], *top.spec.extents[:2]) / 2.0
    beside = max(abs(top.pose.x - bottom.pose.x), abs(top.pose.y - bottom.pose.y))
    return beside <= reach and carries(scene, bottom, top)


def stacked(scene: Scene, items: Iterable[SceneObject]) -> bool:
    """Whether items form one stack: the lowest on the ground, each of the others on the one before alone."""
    lowest, *others = sorted(items, key=lambda item: item.pose.z)
    chain = zip([lowest, *others], others, strict=False)
    return (
        not any(is_held(scene, item) for item in (lowest, *others))
        and on_ground(scene, lowest)
        and all(on_top(scene, below, item) and not on_ground(scene, item) for below, item in chain)
    )


def inside(item: SceneObject, container: SceneObject) -> bool:
    """Whether an item's origin is, seen from above, within the outer sides of a container."""
    place = container.pose.inverse().transform(item.pose.position)
    low, high = container.spec.mesh.bounds.tolist()
    return all(low[axis] < place[axis] < high[axis] for axis in (0, 1))


def is_top(item: SceneObject, pool: Sequence[SceneObject]) -> bool:
    """Whether none of the items in the pool is above an item."""
    return not any(
        other.pose.z > item.pose.z
        and planar_distance(other.pose.position, item.pose.position) < min(item.spec.extents[:2])
        for other in pool
        if other is not item
    )


def middle(items: Sequence[SceneObject]) -> Point:
    """Return the mean x and y (m) of items."""
    x, y = (sum(item.pose.position[axis] for item in items) / len(items) for axis in (0, 1))
    return (x, y)


def between(item: SceneObject, others: Sequence[SceneObject], reach: float) -> bool:
    """Whether an item is, seen from above, less than ``reach`` (m) from the middle of others."""
    return planar_distance(item.pose.position, middle(others)) < reach


def heading(item: SceneObject) -> float:
    """Return the direction (rad) of an item's y axis, a long block's long side, seen from above."""
    rotation = item.cached_by_pose(_rotation)
    return math.atan2(rotation[1, 1], rotation[0, 1])


def in_line(item: SceneObject, others: Sequence[SceneObject]) -> bool:
    """Whether an item's y axis is along the line from the first of the others to the last."""
    (x0, y0, _), (x1, y1, _) = others[0].pose.position, others[-1].pose.position
    return abs(wrap_angle(heading(item) - math.atan2(y1 - y0, x1 - x0), math.pi)) < IN_LINE


def is_level(item: SceneObject) -> bool:
    """Whether an item's y axis is tilted no more than what stands upright."""
    return abs(float(item.cached_by_pose(_rotation)[2, 1])) < math.sin(UPRIGHT)


def lies_flat(item: SceneObject) -> bool:
    """Whether one of an item's axes is upright: a block that has rolled onto another side lies flat."""
    return item.cached_by_pose(_steepest) > math.cos(UPRIGHT)


def _steepest(item: SceneObject) -> float:
    """Return the greatest cosine of an axis of an item with the vertical."""
    return float(abs(item.cached_by_pose(_rotation)[2]).max())


def rests_on(scene: Scene, bottom: SceneObject, top: SceneObject) -> bool:
    """Whether an item touches another that it is higher than: lies on it, if only with an edge."""
    return top.pose.z > bottom.pose.z + TOUCHING and touching(scene, bottom, top)
