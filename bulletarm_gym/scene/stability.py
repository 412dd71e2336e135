"""Tests whether bodies are at rest, and simulation until they are."""

import math
from collections.abc import Sequence

from bulletarm_gym.geometry import matrix, rotate
from bulletarm_gym.simulation import Body, Slide, World
from bulletarm_gym.simulation.state import REST_SPEED
from bulletarm_gym.surfaces.surface import UP, Surface

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

    Bullet never slows some flat blocks that spin. If the limit is reached, bodies that spin on the spot are
    stopped, and a quarter of the limit is simulated again.
    """
    if not _come_to_rest(world, bodies, limit) and world.stop_spins(bodies):
        _come_to_rest(world, bodies, limit // 4)
    world.end()
    world.unsettled.clear()


def _come_to_rest(world: World, bodies: Sequence[Body], limit: int) -> bool:
    """Simulate until bodies rest, and return False if the limit is reached before.

    A body rests if it is slow in two consecutive steps and does not accelerate, as a tipping body does.
    """
    speeds, calm = [world.speed(body) for body in bodies], 0
    for _ in range(limit):
        world.step()
        before, speeds = speeds, [world.speed(body) for body in bodies]
        calm = calm + 1 if all(speed < REST_SPEED for speed in speeds) else 0
        steady = all(now <= max(old, CREEP_SPEED) for old, now in zip(before, speeds, strict=True))
        if calm > 1 and (steady or calm > CALM_STEPS):
            return True
    return False


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
    return all(
        isinstance(part, Slide) and abs(rotate(orientation, part.axis)[2]) < CONTACT
        for part in body.spec.parts
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
