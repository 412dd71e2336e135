"""Predicates on objects, for the goals of tasks and the plans of experts."""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.geometry import FloatArray, Footprint, matrix, planar_distance, rotate, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject, cached_by_pose
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.simulation.state import REST_SPEED
from bulletarm_gym.surfaces.surface import UP, Point, Surface

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


def on_site(scene: Scene, obj: SceneObject) -> bool:
    """Return True if an object stands on the level part of the surface where structures are built."""
    level = abs(obj.lowest - scene.surface.level) <= TOUCHING
    return level and scene.surface.fits_site(_inner_footprint(obj))


@cached_by_pose
def _inner_footprint(obj: SceneObject) -> Footprint:
    return Footprint.of(obj.spec.mesh.vertices, obj.pose).grown(-TOUCHING)


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


CONTACT = 1e-4
"""Maximum gap or overlap (m) between a body and the surface that supports it."""
EMBEDDED = 1.5e-3
"""Maximum overlap (m) with a body of the surface. Bullet adds 1 mm to hulls."""
APART = 2e-3
"""Gap (m) between two bodies above which neither supports the other."""
OVER_EDGE = math.pi - 0.1
"""Maximum angle (rad) between neighbouring contacts about the centre of mass of a stable body."""
GRIP = 0.9
"""Maximum slope relative to the friction coefficient."""
CREEP_SPEED = 1e-3
"""Speed (m/s) below which changes between simulation steps are noise of the contact solver."""
CALM_STEPS = 24
"""Number of simulation steps after which bodies slower than ``REST_SPEED`` rest, even if some accelerate."""


def settle(world: World, bodies: Sequence[Body], limit: int) -> None:
    """Simulate until bodies rest, at most ``limit`` simulation steps, and read the state.

    A body rests if it is slow in two consecutive steps and does not accelerate, as a tipping body does.
    """
    speeds, calm = [world.speed(body) for body in bodies], 0
    for _ in range(limit):
        world.step()
        before, speeds = speeds, [world.speed(body) for body in bodies]
        calm = calm + 1 if all(speed < REST_SPEED for speed in speeds) else 0
        steady = all(now <= max(old, CREEP_SPEED) for old, now in zip(before, speeds, strict=True))
        if calm > 1 and (steady or calm > CALM_STEPS):
            break
    world.end()
    world.unsettled.clear()


def is_stable(world: World, surface: Surface, bodies: Sequence[Body]) -> bool:
    """Return True if the surface alone supports each body at rest, so that none can fall or slide.

    If the result is False, the bodies have to be simulated.
    """
    return surface.keeps_poses and all(
        _has_level_slides(world, body) if body.spec.mass == 0.0 else _stands_alone(world, surface, body)
        for body in bodies
    )


def _has_level_slides(world: World, body: Body) -> bool:
    """Return True if gravity does not move the parts of a fixed body."""
    orientation = world.poses[body.index].orientation
    return not body.spec.hinges and all(
        abs(rotate(orientation, slide.axis)[2]) < CONTACT for slide in body.spec.slides
    )


def _stands_alone(world: World, surface: Surface, body: Body) -> bool:
    """Return True if the surface supports a body on all sides and no other body touches it."""
    pose, spec = world.poses[body.index], body.spec
    vertices = spec.mesh.vertices @ matrix(pose).T + pose.position
    gaps = vertices[:, 2] - surface.heights(vertices[:, :2])
    if gaps.min() < -CONTACT or spec.parts:
        return False
    x, y, _ = pose.transform(spec.mass_properties[0].position)
    contacts = vertices[gaps < CONTACT].tolist()
    return (
        _surrounds([math.atan2(v - y, u - x) for u, v, _ in contacts])
        and _resists_sliding(world, surface, body, (x, y))
        and not any(
            world.are_near(body, other, -EMBEDDED if other in surface.bodies else APART)
            for other in world.obstacles
            if other is not body
        )
    )


def _surrounds(angles: list[float]) -> bool:
    """Return True if contacts at these angles (rad) surround the centre of mass."""
    angles = sorted(angles)
    ends = [*angles[1:], *(angle + 2.0 * math.pi for angle in angles[:1])]
    return bool(angles) and max(end - start for start, end in zip(angles, ends, strict=True)) < OVER_EDGE


def _resists_sliding(world: World, surface: Surface, body: Body, point: tuple[float, float]) -> bool:
    """Return True if friction prevents a body from sliding down the surface at a point."""
    normal = surface.normal(point)
    if tuple(normal) == UP:
        return True
    ground = min(world.get_properties(other).friction for other in surface.bodies)
    friction = world.get_properties(body).friction * ground
    return math.hypot(normal[0], normal[1]) < GRIP * friction * normal[2]
