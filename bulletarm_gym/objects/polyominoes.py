"""The random blocks of the improvise tasks: cells side by side in one layer.

The paper draws them from a set made by a program of its own. These 19 are as large and as diverse: six fill a
square of three cells a side, ten three by four cells, two four by four, one three by five.
"""

import colorsys
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.geometry import Vector
from bulletarm_gym.objects.solids import block
from bulletarm_gym.simulation.shapes import BodySpec, Colour

CELL = 0.02
"""Side (m) of a cell at scale 1 and stretch 1."""
LAYER = 0.022
"""Height (m) of the layer at scale 1 and rise 1."""
STRETCH = (1.0, 1.5)
RISE = (2.0, 2.2)
"""Ranges that a block's sizes in the plane and its height are drawn from: 0.6 to 0.9 and 1.2 to 1.32 at scale
0.6."""
WIDEST = 5.2
"""Greatest product of stretch and cells along x: at scale 0.6 that is 62 mm, which every gripper takes."""
MASS = 0.1
FRICTION = 1.0
"""That of the other blocks, so that they lie as still on the steepest ramp."""
SEED = 19
GOLDEN_RATIO = 0.618

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
"""The blocks seen from above: a word a row of cells along x, rows along y."""


def improvise_block(
    name: str, scale: float, number: int, stretch: float = 1.25, rise: float = 2.1
) -> BodySpec:
    """Return one of the 19 blocks; its frame is at its centre of mass, so that it is grasped there.

    :param number: 0 to 18
    :param stretch: times its size in the plane, but for blocks that would become too wide for a gripper
    :param rise: times its height
    """
    rows = DRAWINGS[number].split()
    side = CELL * scale * min(stretch, WIDEST / len(rows[0]))
    height = LAYER * scale * rise
    cells = np.array([(x, y) for y, row in enumerate(rows) for x, cell in enumerate(row) if cell == "#"])
    middle = cells.mean(axis=0)
    pieces = []
    for low, high in _bars(rows):
        x, y = ((np.add(low, high) / 2.0 - middle) * side).tolist()
        extents: Vector = ((high[0] - low[0] + 1) * side, (high[1] - low[1] + 1) * side, height)
        pieces.append(block(extents, (x, y, 0.0)))
    return BodySpec(name, tuple(pieces), MASS, FRICTION, colour=_colour(number))


def improvise_blocks(name: str, scale: float, series: int) -> tuple[BodySpec, ...]:
    """Return the 19 blocks, each of a random size, always the same.

    :param series: of sizes: two items with different ones are hardly ever alike
    """
    rng = np.random.default_rng((SEED, series))
    sizes = zip(rng.uniform(*STRETCH, len(DRAWINGS)), rng.uniform(*RISE, len(DRAWINGS)), strict=True)
    return tuple(
        improvise_block(f"{name} {number}", scale, number, float(stretch), float(rise))
        for number, (stretch, rise) in enumerate(sizes)
    )


def _bars(rows: list[str]) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield the first and last cell, (x, y), of rectangles that cover the cells, each cell once."""
    left = {(x, y) for y, row in enumerate(rows) for x, cell in enumerate(row) if cell == "#"}
    while left:
        x, y = low = min(left, key=lambda cell: (cell[1], cell[0]))
        while (x + 1, y) in left:
            x += 1
        while all((column, y + 1) in left for column in range(low[0], x + 1)):
            y += 1
        yield low, (x, y)
        left -= {(column, row) for column in range(low[0], x + 1) for row in range(low[1], y + 1)}


def _colour(number: int) -> Colour:
    """Return a colour unlike those of the blocks before."""
    red, green, blue = colorsys.hsv_to_rgb(number * GOLDEN_RATIO % 1.0, 0.55, 0.8)
    return (red, green, blue, 1.0)
