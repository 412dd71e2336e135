"""The paper's blocks.

Sizes are nominal (m) and grow with the object scale; masses are those of the original BulletArm release.
"""

from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.solids import loft
from bulletarm_gym.simulation.shapes import BLUE, RED, YELLOW, BodySpec, Box, Piece

CUBE_SIZE = 0.05
"""Side (m) of cubes and of a triangle's bounding box at scale 1 (paper, Environments); 3 cm at 0.6."""
CUBE_MASS = 0.1

FLAT_BLOCK_SIDE = 0.1
"""Side (m) at scale 1: 8 cm at the pulling task's default scale of 0.8 (paper, Block Pulling)."""
FLAT_BLOCK_HEIGHT = 0.05
"""Height (m), the same at every scale (paper, Block Pulling)."""
FLAT_BLOCK_MASS = 0.5
FLAT_BLOCK_FRICTION = 0.5

MARK_THICKNESS = 1e-3
"""Height (m) of marks on the ground: enough for a camera to see them."""


def cube(name: str, scale: float) -> BodySpec:
    """Return a cube whose frame is its centre."""
    side = CUBE_SIZE * scale
    return BodySpec(name, (Piece(Box((side, side, side))),), CUBE_MASS, colour=RED)


def flat_block(name: str, scale: float) -> BodySpec:
    """Return a square block lower than it is wide, its frame in its centre."""
    side = FLAT_BLOCK_SIDE * scale
    pieces = (Piece(Box((side, side, FLAT_BLOCK_HEIGHT))),)
    return BodySpec(name, pieces, FLAT_BLOCK_MASS, FLAT_BLOCK_FRICTION, colour=BLUE)


def triangle(name: str, scale: float) -> BodySpec:
    """Return an upright prism whose ridge runs along x, its frame in the middle of its bounding box."""
    half = CUBE_SIZE * scale / 2.0
    rings = [[(x, -half, -half), (x, half, -half), (x, 0.0, half)] for x in (-half, half)]
    return BodySpec(name, (Piece(loft(rings)),), CUBE_MASS, colour=YELLOW)


def goal_area(name: str, side: float) -> BodySpec:
    """Return a square of ``side`` (m) marked on the ground, its frame on the ground in its middle."""
    square = Piece(Box((side, side, MARK_THICKNESS)), Pose((0.0, 0.0, MARK_THICKNESS / 2.0)))
    return BodySpec(name, (square,), mass=0.0, colour=BLUE, is_mark=True)
