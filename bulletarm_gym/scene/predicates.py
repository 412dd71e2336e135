"""Predicates on objects, for the goals of tasks and the plans of experts."""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.geometry import FloatArray, matrix, planar_distance, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject, cached_by_pose
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.surfaces.surface import Point

TOUCHING = 2e-3
"""Largest gap (m) between two objects in contact: a collision leaves gaps of this size."""
UPRIGHT = math.pi / 9.0
"""Largest tilt (rad) of an upright object."""
IN_LINE = math.pi / 7.0
"""Largest angle (rad) between a long block and the line through the blocks that support it."""


def loose_objects(scene: Scene) -> list[SceneObject]:
    """Return the present objects that are not fixed."""
    return [obj for obj in scene if obj.spec.mass > 0.0]


def success_at_rest(scene: Scene, **facts: bool) -> dict[str, bool]:
    """Return a task's facts, ``is_empty`` and ``is_at_rest``, with ``success`` if all of them are True."""
    facts |= {"is_empty": is_empty(scene), "is_at_rest": at_rest(scene)}
    return {"success": all(facts.values()), **facts}


def touching(scene: Scene, first: SceneObject, second: SceneObject) -> bool:
    """Return True if two objects are in contact."""
    return scene.world.are_near(first.body, second.body, TOUCHING)


def is_held(scene: Scene, obj: SceneObject) -> bool:
    """Return True if the gripper holds an object."""
    return scene.robot.held is obj.body


def is_empty(scene: Scene) -> bool:
    """Return True if the gripper holds nothing."""
    return scene.robot.held is None


def at_rest(scene: Scene) -> bool:
    """Return True if nothing moves."""
    return not scene.world.has_motion


def upright(obj: SceneObject) -> bool:
    """Return True if the z axis of an object is nearly vertical."""
    return obj.pose.tilt < UPRIGHT


def on_surface(scene: Scene, obj: SceneObject) -> bool:
    """Return True if an object touches the surface, level or not."""
    world = scene.world
    bodies = (body for body in scene.surface.bodies if world.active[body.index])
    return any(world.are_near(obj.body, body, TOUCHING) for body in bodies)


def on_ground(scene: Scene, obj: SceneObject) -> bool:
    """Return True if the lowest point of an object is at the height of the level ground for structures."""
    return abs(obj.lowest - scene.surface.level) <= TOUCHING


def on_site(scene: Scene, obj: SceneObject) -> bool:
    """Return True if a whole object is on the level ground for structures."""
    return on_ground(scene, obj) and scene.surface.fits_site(footprint(obj).grown(-TOUCHING))


def rests_on(scene: Scene, bottom: SceneObject, top: SceneObject) -> bool:
    """Return True if an object touches another and its origin is higher."""
    return top.pose.z > bottom.pose.z + TOUCHING and touching(scene, bottom, top)


def carries(scene: Scene, bottom: SceneObject, top: SceneObject) -> bool:
    """Return True if an object touches another and is higher by half the smaller height."""
    rise = top.pose.z - bottom.pose.z
    return rise >= min(bottom.spec.extents[2], top.spec.extents[2]) / 2.0 and touching(scene, bottom, top)


def on_top(scene: Scene, bottom: SceneObject, top: SceneObject) -> bool:
    """Return True if an object carries another whose centre is above it."""
    reach = max(*bottom.spec.extents[:2], *top.spec.extents[:2]) / 2.0
    offset = max(abs(top.pose.x - bottom.pose.x), abs(top.pose.y - bottom.pose.y))
    return offset <= reach and carries(scene, bottom, top)


def stacked(scene: Scene, objects: Iterable[SceneObject]) -> bool:
    """Return True if objects form one stack on the surface and none of them is grasped."""
    lowest, *others = sorted(objects, key=lambda obj: obj.pose.z)
    pairs = zip([lowest, *others], others, strict=False)
    return (
        not any(is_held(scene, obj) for obj in (lowest, *others))
        and on_surface(scene, lowest)
        and all(on_top(scene, below, obj) and not on_surface(scene, obj) for below, obj in pairs)
    )


def inside(obj: SceneObject, container: SceneObject) -> bool:
    """Return True if an object's origin is horizontally within the outer sides of a container."""
    position = container.pose.inverse().transform(obj.pose.position)
    low, high = container.spec.mesh.bounds.tolist()
    return all(low[axis] < position[axis] < high[axis] for axis in (0, 1))


def is_top(obj: SceneObject, objects: Sequence[SceneObject]) -> bool:
    """Return True if none of the objects is above an object."""
    return not any(
        other.pose.z > obj.pose.z
        and planar_distance(other.pose.position, obj.pose.position) < min(obj.spec.extents[:2])
        for other in objects
        if other is not obj
    )


def middle(objects: Sequence[SceneObject]) -> Point:
    """Return the mean x and y (m) of objects."""
    x, y = (sum(obj.pose.position[axis] for obj in objects) / len(objects) for axis in (0, 1))
    return (x, y)


def between(obj: SceneObject, others: Sequence[SceneObject], distance: float) -> bool:
    """Return True if an object is horizontally less than ``distance`` (m) from the middle of others."""
    return planar_distance(obj.pose.position, middle(others)) < distance


def direction(first: SceneObject, last: SceneObject) -> float:
    """Return the horizontal direction (rad) from an object to another."""
    return math.atan2(last.pose.y - first.pose.y, last.pose.x - first.pose.x)


def heading(obj: SceneObject) -> float:
    """Return the horizontal direction (rad) of an object's y axis, the long axis of a long block."""
    rotation = _rotation(obj)
    return math.atan2(rotation[1, 1], rotation[0, 1])


def lies_along(obj: SceneObject, others: Sequence[SceneObject]) -> bool:
    """Return True if an object's y axis is level and along the line from the first to the last of others."""
    is_level = abs(float(_rotation(obj)[2, 1])) < math.sin(UPRIGHT)
    angle = wrap_angle(heading(obj) - direction(others[0], others[-1]), math.pi)
    return is_level and abs(angle) < IN_LINE


@cached_by_pose
def lies_flat(obj: SceneObject) -> bool:
    """Return True if one of an object's axes is nearly vertical."""
    return float(abs(_rotation(obj)[2]).max()) > math.cos(UPRIGHT)


@cached_by_pose
def _rotation(obj: SceneObject) -> FloatArray:
    return matrix(obj.pose)
