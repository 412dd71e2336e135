"""A corner of two walls on a plate."""

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation.shapes import BodySpec, Box, Piece

SIDE = 0.2
"""Of the plate and the walls (m)."""
PLATE = 0.01
"""Thickness (m) of the plate. Through a thinner one a finger that presses harder than needed would push a
block down to the ground, which holds it."""
WALL_HEIGHT = 0.09
"""Metres above the ground; over a wall of 10 cm the Panda's wide hand cannot reach the cube."""
WALL = 0.03
"""Thickness (m) of the walls, outwards. Round one of 2 cm a finger slips and the cube is gripped with
its wall."""
INSIDE = -0.09
"""Where (m) along x and y the walls' inner faces are, in the corner's frame."""
FRICTION = 0.2
"""Low, so that a finger pressed on a block takes it along."""
COLOUR = (0.78, 0.78, 0.80, 1.0)


def corner(name: str) -> BodySpec:
    """Return a corner open towards +x and +y, its frame on the ground in the middle of its plate."""
    pieces = (
        _block((SIDE, SIDE, PLATE), (0.0, 0.0, PLATE / 2.0)),
        _block((WALL, SIDE, WALL_HEIGHT), (INSIDE - WALL / 2.0, 0.0, WALL_HEIGHT / 2.0)),
        _block((SIDE, WALL, WALL_HEIGHT), (0.0, INSIDE - WALL / 2.0, WALL_HEIGHT / 2.0)),
    )
    return BodySpec(name, pieces, 0.0, FRICTION, colour=COLOUR)


def _block(extents: Vector, centre: Vector) -> Piece:
    return Piece(Box(extents), Pose(centre))
