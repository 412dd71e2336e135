"""Boxes and the pallet they are stacked on (paper, Box Palletizing)."""

from bulletarm_gym.geometry import Vector
from bulletarm_gym.objects.solids import block
from bulletarm_gym.simulation.shapes import BodySpec, Colour, Piece

BOX: Vector = (0.05625, 0.09, 0.05625)
"""Side lengths (m) at scale 1: 7.2 x 4.5 x 4.5 cm at the default scale of 0.8 (paper, Box Palletizing)."""
BOX_MASS = 0.1
BROWN: Colour = (0.58, 0.40, 0.26, 1.0)

PALLET: Vector = (0.232, 0.192, 0.03)
"""Side lengths (m; paper, Box Palletizing); the pallet does not scale."""
BOARDS = 6
BOARD_WIDTH = 0.028
BOARD_HEIGHT = 0.008
BEARERS = 3
BEARER_WIDTH = 0.02
WOOD: Colour = (0.82, 0.66, 0.44, 1.0)


def palletizing_box(name: str, scale: float) -> BodySpec:
    """Return a box longer along y, its frame in its centre."""
    x, y, z = (side * scale for side in BOX)
    return BodySpec(name, (block((x, y, z)),), BOX_MASS, colour=BROWN)


def pallet(name: str, scale: float = 1.0) -> BodySpec:
    """Return a pallet, fixed where it is put, its frame on the ground in its middle.

    Boards along y lie on bearers along x, its long side.
    """
    x, y, z = PALLET
    pitch = (x - BOARD_WIDTH) / (BOARDS - 1)
    boards = [
        block(
            (BOARD_WIDTH, y, BOARD_HEIGHT),
            ((number - (BOARDS - 1) / 2.0) * pitch, 0.0, z - BOARD_HEIGHT / 2.0),
        )
        for number in range(BOARDS)
    ]
    depth, across = z - BOARD_HEIGHT, (y - BEARER_WIDTH) / (BEARERS - 1)
    bearers = [
        block((x, BEARER_WIDTH, depth), (0.0, (number - (BEARERS - 1) / 2.0) * across, depth / 2.0))
        for number in range(BEARERS)
    ]
    pieces: list[Piece] = [piece.scaled(scale) for piece in (*boards, *bearers)]
    return BodySpec(name, tuple(pieces), 0.0, colour=WOOD)
