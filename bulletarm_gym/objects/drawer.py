"""A cabinet with a drawer to be opened by its handle."""

import math

from bulletarm_gym.geometry import Pose, Quaternion, Vector
from bulletarm_gym.objects.solids import block, circle, extruded
from bulletarm_gym.simulation.shapes import BodySpec, Piece, Slide

CABINET: Vector = (0.213, 0.228, 0.108)
"""Side lengths (m) of the cabinet."""
DRAWER: Vector = (0.2, 0.21, 0.09)
"""Side lengths (m) of the drawer."""
WALL = 0.006
"""Thickness (m) of all walls."""
TRAVEL = 0.18
"""How far (m) the drawer comes out."""
HANDLE_HEIGHT = 0.054
HANDLE_DISTANCE = 0.05
"""Distance (m) of the bar's axis from the drawer's front."""
HANDLE_LENGTH = 0.1
HANDLE_RADIUS = 0.0075
STRUT_RADIUS = 0.005
STRUT_SPACING = 0.07
"""Distance (m) between the two struts that carry the bar."""
MASS = 0.35
"""Of the drawer with its handle (kg)."""
RESISTANCE = 1.0
"""Force (N) that keeps the drawer where it is left."""
FRONT = -CABINET[0] / 2.0
"""Where (m) along x the drawer's front is, in the cabinet's frame, when it is shut."""
HANDLE: Vector = (FRONT - HANDLE_DISTANCE, 0.0, HANDLE_HEIGHT)
"""Middle (m) of the bar in the cabinet's frame, when the drawer is shut."""
ALONG_Y: Quaternion = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
ALONG_X: Quaternion = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))
GREY = (0.78, 0.78, 0.80, 1.0)
DARK = (0.45, 0.46, 0.50, 1.0)


def drawer(name: str) -> BodySpec:
    """Return a cabinet whose drawer opens towards -x, its frame on the ground in the cabinet's middle."""
    slide = Slide(
        "drawer",
        (*_box(), *_handle()),
        MASS,
        axis=(-1.0, 0.0, 0.0),
        limits=(0.0, TRAVEL),
        resistance=RESISTANCE,
        colour=DARK,
    )
    return BodySpec(name, _shell(), 0.0, colour=GREY, slides=(slide,))


def _shell() -> tuple[Piece, ...]:
    x, y, z = CABINET
    sides = [block((x, WALL, z), (0.0, sign * (y - WALL) / 2.0, z / 2.0)) for sign in (1.0, -1.0)]
    plates = [block((x, y, WALL), (0.0, 0.0, height)) for height in (WALL / 2.0, z - WALL / 2.0)]
    return (*sides, *plates, block((WALL, y, z), ((x - WALL) / 2.0, 0.0, z / 2.0)))


def _box() -> tuple[Piece, ...]:
    x, y, z = DRAWER
    middle, low = FRONT + x / 2.0, (CABINET[2] - z) / 2.0
    height = low + z / 2.0
    ends = [block((WALL, y, z), (end, 0.0, height)) for end in (FRONT + WALL / 2.0, FRONT + x - WALL / 2.0)]
    sides = [block((x, WALL, z), (middle, sign * (y - WALL) / 2.0, height)) for sign in (1.0, -1.0)]
    return (*ends, *sides, block((x, y, WALL), (middle, 0.0, low + WALL / 2.0)))


def _handle() -> tuple[Piece, ...]:
    bar = _rod(HANDLE_RADIUS, HANDLE_LENGTH, Pose(HANDLE, ALONG_Y))
    middle = FRONT - HANDLE_DISTANCE / 2.0
    ends = [(middle, sign * STRUT_SPACING / 2.0, HANDLE_HEIGHT) for sign in (1.0, -1.0)]
    return (bar, *(_rod(STRUT_RADIUS, HANDLE_DISTANCE, Pose(end, ALONG_X)) for end in ends))


def _rod(radius: float, length: float, pose: Pose) -> Piece:
    return Piece(extruded(circle(radius, 0.0)[:, :2], length).shape, pose)
