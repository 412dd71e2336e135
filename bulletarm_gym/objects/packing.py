"""Seven shapes to be packed and the bin for them (paper, Bin Packing)."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from bulletarm_gym.objects.solids import beam, block, circle, container, corner_radius, extruded
from bulletarm_gym.simulation.shapes import BodySpec, Colour, Piece

SIDE = 0.05
"""Width (m) at scale 1 of all shapes; they are one or two of it long and half of it or one high: 4 x 4 x 2 to
8 x 4 x 4 cm at the default scale of 0.8 (paper, Bin Packing)."""
MASS = 0.1
FRICTION = 0.5
ARCH_SEGMENTS = 4
DISC_SIDES = 16
CUT = 0.25
"""What the octagonal plate lacks at each corner, in widths."""

BIN = (0.176, 0.144, 0.08)
"""Outer side lengths (m; paper, Bin Packing); the bin does not scale."""
BIN_WALL = 0.004
"""Thickness (m) of walls and floor."""
GREY: Colour = (0.78, 0.78, 0.80, 1.0)


def _wedge() -> list[Piece]:
    return [beam([(-1.0, -0.5), (1.0, -0.5), (0.0, 0.5)], 1.0)]


def _arch() -> list[Piece]:
    legs = [block((1.0, 0.5, 1.0), (0.0, side * 0.75, 0.0)) for side in (-1.0, 1.0)]
    turns = np.pi * (1.0 - np.arange(ARCH_SEGMENTS + 1) / ARCH_SEGMENTS)
    vault = [(0.5 * math.cos(turn), 0.5 * math.sin(turn) - 0.5) for turn in turns.tolist()]
    columns = [[low, high, (high[0], 0.5), (low[0], 0.5)] for low, high in pairwise(vault)]
    return [*legs, *(beam(column, 1.0) for column in columns)]


def _octagon() -> list[Piece]:
    near, far = 0.5 - CUT, 0.5
    corners = [(far, near), (near, far), (-near, far), (-far, near)]
    return [extruded([*corners, *((-x, -y) for x, y in corners)], 0.5)]


def _disc() -> list[Piece]:
    return [extruded(circle(corner_radius(1.0, DISC_SIDES), 0.0, DISC_SIDES)[:, :2], 0.5)]


SHAPES: tuple[tuple[Callable[[], list[Piece]], Colour], ...] = (
    (_wedge, (0.20, 0.55, 0.25, 1.0)),
    (_arch, (0.30, 0.75, 0.50, 1.0)),
    (_octagon, (0.85, 0.25, 0.60, 1.0)),
    (lambda: [block((1.0, 2.0, 0.5))], (0.25, 0.75, 0.80, 1.0)),
    (lambda: [block((1.0, 1.0, 1.0))], (0.50, 0.40, 0.75, 1.0)),
    (lambda: [block((1.0, 2.0, 1.0))], (0.40, 0.45, 0.85, 1.0)),
    (_disc, (0.85, 0.50, 0.25, 1.0)),
)
"""The seven shapes, their width as unit, long side along y; and their colours."""


def packing_block(name: str, scale: float, number: int) -> BodySpec:
    """Return one of the seven shapes, its frame in the middle of its bounding box.

    :param number: 0 to 6
    """
    make, colour = SHAPES[number]
    pieces = tuple(piece.scaled(SIDE * scale) for piece in make())
    return BodySpec(name, pieces, MASS, FRICTION, colour=colour)


def packing_bin(name: str, scale: float = 1.0) -> BodySpec:
    """Return the bin, fixed where it is put, long along x, its frame on the ground in its middle."""
    pieces = tuple(piece.scaled(scale) for piece in container(BIN, BIN_WALL, BIN_WALL))
    return BodySpec(name, pieces, 0.0, colour=GREY)
