"""The paper's blocks.

Sizes are nominal (m) and grow with the object scale.
"""

import numpy as np

from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.solids import circle, corner_radius, extruded, loft
from bulletarm_gym.simulation.shapes import BLUE, RED, YELLOW, BodySpec, Box, Piece

CUBE_SIZE = 0.05
"""Side (m) of cubes and of a triangle's bounding box at scale 1 (paper, Environments); 3 cm at 0.6."""
CUBE_MASS = 0.1

BRICK_LENGTH = 0.2
"""Of brick and roof at scale 1 (m): 12 cm at the default scale of 0.6 (paper, House Building 3)."""
CYLINDER_DIAMETER = 0.0538
CYLINDER_HEIGHT = 0.06
"""At scale 1 (m)."""
CYLINDER_SIDES = 16

IMPROVISE_WIDTH = (5.0 / 6.0, 7.0 / 6.0)
IMPROVISE_HEIGHT = (2.0 / 3.0, 7.0 / 6.0)
"""Least and greatest size of an improvised brick, width and length alike and height by itself, as shares of
a brick's: 0.5 to 0.7 and 0.4 to 0.7 at scale 0.6."""
IMPROVISE_SEED = 3

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
    return _wedge(name, scale, CUBE_SIZE)


def _wedge(name: str, scale: float, length: float) -> BodySpec:
    half, end = CUBE_SIZE * scale / 2.0, length * scale / 2.0
    rings = [[(x, -end, -half), (x, end, -half), (x, 0.0, half)] for x in (-half, half)]
    return BodySpec(name, (Piece(loft(rings)),), CUBE_MASS, colour=YELLOW)


def brick(name: str, scale: float) -> BodySpec:
    """Return a cuboid four times as long, along y, as it is wide and high, its frame in its centre."""
    return _brick(name, scale, 1.0, 1.0, 1.0)


def improvise_bricks(name: str, scale: float, count: int) -> tuple[BodySpec, ...]:
    """Return bricks of random sizes, always the same (Improvise House Building 3)."""
    rng = np.random.default_rng(IMPROVISE_SEED)
    shares = np.column_stack(
        [rng.uniform(*IMPROVISE_WIDTH, (count, 2)), rng.uniform(*IMPROVISE_HEIGHT, count)]
    )
    return tuple(_brick(f"{name} {number}", scale, *row) for number, row in enumerate(shares.tolist()))


def _brick(name: str, scale: float, width: float, length: float, height: float) -> BodySpec:
    side = CUBE_SIZE * scale
    extents = (width * side, length * BRICK_LENGTH * scale, height * side)
    return BodySpec(name, (Piece(Box(extents)),), CUBE_MASS, colour=BLUE)


def roof(name: str, scale: float) -> BodySpec:
    """Return an upright prism as long, along y, as a brick, its ridge along x, its frame as a triangle's."""
    return _wedge(name, scale, BRICK_LENGTH)


def cylinder(name: str, scale: float) -> BodySpec:
    """Return an upright cylinder whose frame is its centre."""
    outline = circle(corner_radius(CYLINDER_DIAMETER * scale, CYLINDER_SIDES), 0.0, CYLINDER_SIDES)[:, :2]
    return BodySpec(name, (extruded(outline, CYLINDER_HEIGHT * scale),), CUBE_MASS, colour=RED)


def goal_area(name: str, side: float) -> BodySpec:
    """Return a square of ``side`` (m) marked on the ground, its frame on the ground in its middle."""
    square = Piece(Box((side, side, MARK_THICKNESS)), Pose((0.0, 0.0, MARK_THICKNESS / 2.0)))
    return BodySpec(name, (square,), mass=0.0, colour=BLUE, is_mark=True)
