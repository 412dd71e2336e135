"""Blocks: the paper's, those to pack and to palletize, and random ones (paper, Environments).

Sizes are nominal (m), at scale 1. The frame is at the centre of the bounding box unless stated otherwise.
"""

import colorsys
import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.objects.solids import Kind, block, corner_radius, cylinder, loft, prism
from bulletarm_gym.simulation.shapes import BLUE, RED, YELLOW, BodySpec, Box, Colour, Piece

MASS = 0.1
"""Mass (kg) of all blocks but the flat one."""
CUBE_SIZE = 0.05
"""Side (m) of cubes and of a triangle's bounding box (paper, Environments: 3 cm at scale 0.6)."""
BRICK_LENGTH = 0.2
"""Length (m) of brick and roof (paper, House Building 3: 12 cm at scale 0.6)."""
CYLINDER_DIAMETER = 0.0538
"""Diameter (m) of the cylinder."""
CYLINDER_HEIGHT = 0.06
"""Height (m) of the cylinder."""
CIRCLE_SIDES = 16
"""Corners of the polygon that approximates the circle of a cylinder or disc."""
IMPROVISE_WIDTH = (5.0 / 6.0, 7.0 / 6.0)
"""Range of the width and the length of a random brick, relative to a brick."""
IMPROVISE_HEIGHT = (2.0 / 3.0, 7.0 / 6.0)
"""Range of the height of a random brick, relative to a brick."""
FLAT_BLOCK_SIDE = 0.1
"""Side (m) of the flat block (paper, Block Pulling: 8 cm at scale 0.8)."""
FLAT_BLOCK_HEIGHT = 0.05
"""Height (m) of the flat block at every scale (paper, Block Pulling)."""
BOX: Vector = (0.05625, 0.09, 0.05625)
"""Side lengths (m) of a box to palletize (paper, Box Palletizing: 4.5 x 7.2 x 4.5 cm at scale 0.8)."""
SIDE = 0.05
"""Width (m) of the blocks to pack, 1 or 2 widths long and 0.5 or 1 high (paper, Bin Packing: 4 cm at 0.8)."""
MARK_THICKNESS = 1e-3
"""Height (m) of marks on the ground, which makes them visible to cameras."""


def _wedge(length: float) -> list[Piece]:
    """Return an upright prism of triangles whose ridge runs along x, ``length`` (m) along y."""
    half, end = CUBE_SIZE / 2.0, length / 2.0
    return [Piece(loft([[(x, -end, -half), (x, end, -half), (x, 0.0, half)] for x in (-half, half)]))]


def _cylinder(scale: float) -> list[Piece]:
    radius = corner_radius(CYLINDER_DIAMETER * scale, CIRCLE_SIDES)
    return [cylinder(radius, CYLINDER_HEIGHT * scale, CIRCLE_SIDES)]


def _flat_block(scale: float) -> list[Piece]:
    return [block((FLAT_BLOCK_SIDE * scale, FLAT_BLOCK_SIDE * scale, FLAT_BLOCK_HEIGHT))]


cube = Kind([block((CUBE_SIZE, CUBE_SIZE, CUBE_SIZE))], MASS, colour=RED)
"""Cube."""
brick = Kind([block((CUBE_SIZE, BRICK_LENGTH, CUBE_SIZE))], MASS, colour=BLUE)
"""Cuboid, four times as long, along y, as it is wide and high."""
triangle = Kind(_wedge(CUBE_SIZE), MASS, colour=YELLOW)
"""Upright triangular prism whose ridge runs along x."""
roof = Kind(_wedge(BRICK_LENGTH), MASS, colour=YELLOW)
"""Upright triangular prism as long, along y, as a brick, whose ridge runs along x."""
upright_cylinder = Kind(_cylinder, MASS, colour=RED)
"""Upright cylinder."""
flat_block = Kind(_flat_block, mass=0.5, friction=0.5, colour=BLUE)
"""Square block lower than it is wide."""
palletizing_box = Kind([block(BOX)], MASS, colour=(0.58, 0.40, 0.26, 1.0))
"""Box to palletize, longest along y."""


def goal_area(name: str, side: float) -> BodySpec:
    """Return a square of ``side`` (m) marked on the ground, its frame on the ground at its centre."""
    square = Piece(Box((side, side, MARK_THICKNESS)), Pose((0.0, 0.0, MARK_THICKNESS / 2.0)))
    return BodySpec(name, (square,), mass=0.0, colour=BLUE, is_mark=True)


def improvise_bricks(name: str, scale: float, count: int) -> tuple[BodySpec, ...]:
    """Return bricks of random sizes, the same in every process (paper, Improvise House Building 3)."""
    rng = np.random.default_rng(3)
    planes, heights = rng.uniform(*IMPROVISE_WIDTH, (count, 2)), rng.uniform(*IMPROVISE_HEIGHT, count)
    side, lengths = CUBE_SIZE * scale, planes[:, 1] * BRICK_LENGTH * scale
    extents = np.stack([planes[:, 0] * side, lengths, heights * side], axis=1).tolist()
    return tuple(
        BodySpec(f"{name} {number}", (block((x, y, z)),), MASS, colour=BLUE)
        for number, (x, y, z) in enumerate(extents)
    )


# Blocks to pack


def _arch() -> list[Piece]:
    legs = [block((1.0, 0.5, 1.0), (0.0, side * 0.75, 0.0)) for side in (-1.0, 1.0)]
    angles = np.pi * (1.0 - np.arange(5) / 4)
    vault = [(0.5 * math.cos(angle), 0.5 * math.sin(angle) - 0.5) for angle in angles.tolist()]
    columns = [[low, high, (high[0], 0.5), (low[0], 0.5)] for low, high in pairwise(vault)]
    return [*legs, *(prism(column, 1.0, axis=0) for column in columns)]


OCTAGON = tuple(
    (x / 4, y / 4) for x, y in ((2, 1), (1, 2), (-1, 2), (-2, 1), (-2, -1), (-1, -2), (1, -2), (2, -1))
)
"""Corners of the octagonal plate, in widths."""
SHAPES: tuple[tuple[Sequence[Piece], Colour], ...] = (
    ([prism([(-1.0, -0.5), (1.0, -0.5), (0.0, 0.5)], 1.0, axis=0)], (0.20, 0.55, 0.25, 1.0)),
    (_arch(), (0.30, 0.75, 0.50, 1.0)),
    ([prism(OCTAGON, 0.5)], (0.85, 0.25, 0.60, 1.0)),
    ([block((1.0, 2.0, 0.5))], (0.25, 0.75, 0.80, 1.0)),
    ([block((1.0, 1.0, 1.0))], (0.50, 0.40, 0.75, 1.0)),
    ([block((1.0, 2.0, 1.0))], (0.40, 0.45, 0.85, 1.0)),
    ([cylinder(corner_radius(1.0, CIRCLE_SIDES), 0.5, CIRCLE_SIDES)], (0.85, 0.50, 0.25, 1.0)),
)
"""Pieces, in widths with the long side along y, and colours of the seven blocks to pack."""


def packing_block(name: str, scale: float, number: int) -> BodySpec:
    """Return one of the seven blocks to pack, by its number from 0."""
    shape, colour = SHAPES[number]
    pieces = tuple(piece.scaled(SIDE * scale) for piece in shape)
    return BodySpec(name, pieces, MASS, friction=0.5, colour=colour)


# Random blocks: squares side by side in one layer. The paper samples them from a set that it does not
# publish; these have the same sizes.

CELL = 0.02
"""Side (m) of a square at stretch 1."""
LAYER = 0.022
"""Height (m) of a random block at rise 1."""
STRETCH = (1.0, 1.5)
"""Range of the factor on a random block's width and length."""
RISE = (2.0, 2.2)
"""Range of the factor on a random block's height."""
MAX_STRETCHED_CELLS = 5.2
"""Maximum product of stretch and squares along x, 62 mm at scale 0.6, which fits every gripper."""

DRAWINGS = (
    "#.. #.. ###",
    "### .#. .#.",
    "#.# #.# ###",
    ".#. ### .#.",
    "##. .#. .##",
    "#.. ##. .##",
    "### .#. .#. .#.",
    "#.. #.. #.. ###",
    "### .#. .#. ###",
    ".#. ### .#. .#.",
    "##. .#. .#. .##",
    "### #.. #.. ###",
    "#.# ### .#. .#.",
    "##. ### .#. .#.",
    ".#. ### ### .#.",
    "#.. ### .#. ##.",
    ".##. #### .##. .#..",
    "#... #### .##. .#..",
    "### .#. .#. .#. ###",
)
"""The 19 random blocks seen from above: one word per row of squares along x, rows along y."""


def improvise_block(
    name: str, scale: float, number: int, stretch: float = 1.25, rise: float = 2.1
) -> BodySpec:
    """Return one of the 19 random blocks, its frame at its centre of mass, where it is grasped.

    :param number: 0 to 18
    :param stretch: factor on its width and length, reduced for blocks too wide for a gripper
    :param rise: factor on its height
    """
    rows = DRAWINGS[number].split()
    side = CELL * scale * min(stretch, MAX_STRETCHED_CELLS / len(rows[0]))
    height = LAYER * scale * rise
    cells = np.array([(x, y) for y, row in enumerate(rows) for x, cell in enumerate(row) if cell == "#"])
    middle = cells.mean(axis=0)
    pieces = []
    for low, high in _rectangles(rows):
        x, y = ((np.add(low, high) / 2.0 - middle) * side).tolist()
        extents: Vector = ((high[0] - low[0] + 1) * side, (high[1] - low[1] + 1) * side, height)
        pieces.append(block(extents, (x, y, 0.0)))
    red, green, blue = colorsys.hsv_to_rgb(number * 0.618 % 1.0, 0.55, 0.8)  # distinct hues
    return BodySpec(name, tuple(pieces), MASS, colour=(red, green, blue, 1.0))


def improvise_blocks(name: str, scale: float, series: int) -> tuple[BodySpec, ...]:
    """Return the 19 random blocks in a numbered series of random sizes, the same in every process."""
    rng = np.random.default_rng((19, series))
    stretches, rises = rng.uniform(*STRETCH, len(DRAWINGS)), rng.uniform(*RISE, len(DRAWINGS))
    return tuple(
        improvise_block(f"{name} {number}", scale, number, stretch, rise)
        for number, (stretch, rise) in enumerate(zip(stretches.tolist(), rises.tolist(), strict=True))
    )


def _rectangles(rows: list[str]) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield the first and last square, (x, y), of rectangles that cover each square once."""
    left = {(x, y) for y, row in enumerate(rows) for x, cell in enumerate(row) if cell == "#"}
    while left:
        x, y = low = min(left, key=lambda cell: (cell[1], cell[0]))
        while (x + 1, y) in left:
            x += 1
        while all((column, y + 1) in left for column in range(low[0], x + 1)):
            y += 1
        yield low, (x, y)
        left -= {(column, row) for column in range(low[0], x + 1) for row in range(low[1], y + 1)}
