"""How deep an arm is in what it touches, and the way out: rigid bodies overlap in Bullet where they press."""

from collections.abc import Sequence
from typing import Any

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.simulation.motion import MAX_DEPTH

YIELDS = 4
"""Most moves out of what the arm is too deep in: the way out of one thing may lead into another."""
TOO_DEEP = 3e-3
"""Depth (m) of what is held in a finger from which it is taken out, though nothing pressed it in any more."""
REMAINING = 1e-3
"""Depth (m) that is left, so that what pressed goes on touching."""


def way_out(world: World, arm: Body, held: Body | None) -> Vector | None:
    """Return the shift (m) that ends the deepest overlap of an arm and its grasped object with other bodies.

    The overlap between the two does not count. The result is None if no overlap is too deep.
    """
    movers = [arm.id] if held is None else [arm.id, held.id]
    # Contacts are those of the last simulation step. They show which pairs of bodies to measure.
    pairs = [
        (mover, other)
        for mover in movers
        for other in sorted({p[2] for p in world.client.getContactPoints(mover) if p[8] < -REMAINING})
        if other not in movers
    ]
    point = _deepest([p for pair in pairs for p in world.client.getClosestPoints(*pair, 0.0)])
    return None if point is None else _along(point, -point[8] - REMAINING)


def push_out(world: World, held: Body | None, arm: Body) -> bool:
    """Move what an arm holds out of a finger; return True if it is too deep in neither."""
    for _ in range(YIELDS):
        if held is None or (way := _way_into(world, held, arm)) is None:
            return True
        world.carry(held, Pose(way).compose(world.poses[held.index]))
    return False


def _way_into(world: World, held: Body, arm: Body) -> Vector | None:
    """Return the shift (m) that takes what is squeezed out of the finger that it is too deep in, or None.

    No farther than must be, and no more than half the way: there is another finger behind it.
    """
    point = _deepest(world.client.getClosestPoints(arm.id, held.id, 0.0))
    pressed = any(p[8] < -MAX_DEPTH for p in world.client.getContactPoints(arm.id, held.id))
    if point is None or not (pressed or -point[8] > TOO_DEEP):
        return None
    return _along(point, max(MAX_DEPTH + point[8], point[8] / 2.0))


def squeeze(world: World, arm: Body, fingers: Sequence[int], held: Body | None) -> float:
    """Return how far (m) fingers must open so that nothing between them is too deep in both."""
    widths = [0.0]
    for other in sorted({p[2] for p in world.client.getContactPoints(arm.id) if p[8] < -REMAINING}):
        points = [world.client.getClosestPoints(arm.id, other, 0.0, finger) for finger in fingers]
        left = MAX_DEPTH if held is not None and other == held.id else REMAINING
        if all(points):
            widths.append(-sum(min(p[8] for p in side) for side in points) - len(points) * left)
    return max(widths)


def _deepest(points: Any) -> Any:
    """Return the deepest of Bullet's points of contact if it is too deep."""
    deepest = min(points, key=lambda point: float(point[8]), default=None)
    return None if deepest is None or -deepest[8] <= MAX_DEPTH else deepest


def _along(point: Any, shift: float) -> Vector:
    """Return a shift (m) along a point's normal, which leads out of the other body into the arm."""
    x, y, z = point[7]
    return (x * shift, y * shift, z * shift)
