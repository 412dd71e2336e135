"""Static test of whether bodies stay where they are, so that most scenes come to rest without simulation."""

import math
from collections.abc import Sequence

from bulletarm_gym.geometry import matrix, rotate
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.surfaces.surface import UP, Surface

CONTACT = 1e-4
"""Greatest gap or overlap (m) of a body that stands on the surface."""
EMBEDDED = 1.5e-3
"""Greatest overlap (m) with a part of the surface: the engine adds 1 mm to hulls."""
APART = 2e-3
"""Gap (m) between two bodies beyond which neither supports the other."""
OVER_EDGE = math.pi - 0.1
"""Greatest angle (rad) between neighbouring contacts, seen from the centre of mass, of a body that stands."""
GRIP = 0.9
"""Greatest slope in relation to the friction coefficient."""


def is_stable(world: World, surface: Surface, bodies: Sequence[Body]) -> bool:
    """Return True if each of the bodies at rest stands on the surface alone, so that none can fall or slide.

    False means that only simulation can decide.
    """
    return surface.keeps_poses and all(
        _stays_shut(world, body) if body.spec.mass == 0.0 else _stands_alone(world, surface, body)
        for body in bodies
    )


def _stays_shut(world: World, body: Body) -> bool:
    """Return True if gravity does not move the parts of a fixed body: level slides."""
    orientation = world.poses[body.index].orientation
    return not body.spec.hinges and all(
        abs(rotate(orientation, slide.axis)[2]) < CONTACT for slide in body.spec.slides
    )


def _stands_alone(world: World, surface: Surface, body: Body) -> bool:
    pose, spec = world.poses[body.index], body.spec
    vertices = spec.mesh.vertices @ matrix(pose).T + pose.position
    gaps = vertices[:, 2] - surface.heights(vertices[:, :2])
    if gaps.min() < -CONTACT or spec.parts:
        return False
    x, y, _ = pose.transform(spec.mass_properties[0].position)
    contacts = vertices[gaps < CONTACT].tolist()
    return (
        _surrounds([math.atan2(v - y, u - x) for u, v, _ in contacts])
        and _holds(world, surface, body, (x, y))
        and not any(_touches(world, surface, body, other) for other in world.obstacles if other is not body)
    )


def _surrounds(angles: list[float]) -> bool:
    """Return True if contacts in some directions (rad) lie all around, so that a body tips to no side."""
    angles = sorted(angles)
    ends = [*angles[1:], *(angle + 2.0 * math.pi for angle in angles[:1])]
    return bool(angles) and max(end - start for start, end in zip(angles, ends, strict=True)) < OVER_EDGE


def _holds(world: World, surface: Surface, body: Body, point: tuple[float, float]) -> bool:
    """Return True if friction keeps a body from sliding down the surface at a point."""
    normal = surface.normal(point)
    if tuple(normal) == UP:
        return True
    ground = min(world.get_properties(other).friction for other in surface.bodies)
    friction = world.get_properties(body).friction * ground
    return math.hypot(normal[0], normal[1]) < GRIP * friction * normal[2]


def _touches(world: World, surface: Surface, body: Body, other: Body) -> bool:
    """Return True if another body may support this one or push it away."""
    gap = -EMBEDDED if other in surface.bodies else APART
    return world.are_near(body, other, gap)
