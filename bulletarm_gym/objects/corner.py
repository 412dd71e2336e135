"""A corner of two walls on a plate."""

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation.shapes import BodySpec, Box, Piece

SIDE = 0.2
"""Of the plate and the walls (m), as in the original BulletArm release."""
PLATE = 0.002
"""Thickness (m) of the plate, as in the original BulletArm release."""
WALL_HEIGHT = 0.08
"""Metres; over the original's 10 cm the Panda's wide hand cannot reach the cube."""
WALL = 0.02
"""Thickness (m) of the walls, which stand on the plate's edges, as in the original BulletArm release."""
INSIDE = -(SIDE - WALL) / 2.0
"""Where (m) along x and y the walls' inner faces are, in the corner's frame."""
FRICTION = 0.2
"""Low, so that a finger pressed on a block takes it along."""
COLOUR = (0.78, 0.78, 0.80, 1.0)


def corner(name: str) -> BodySpec:
    """Return a corner open towards +x and +y, its frame on the ground in the middle of its plate."""
    pieces = (
        _block((SIDE, SIDE, PLATE), (0.0, 0.0, PLATE / 2.0)),
        _block((WALL, SIDE, WALL_HEIGHT), (-SIDE / 2.0, 0.0, WALL_HEIGHT / 2.0)),
        _block((SIDE, WALL, WALL_HEIGHT), (0.0, -SIDE / 2.0, WALL_HEIGHT / 2.0)),
    )
    return BodySpec(name, pieces, 0.0, FRICTION, colour=COLOUR)


def _block(extents: Vector, centre: Vector) -> Piece:
    return Piece(Box(extents), Pose(centre))
