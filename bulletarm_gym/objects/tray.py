"""The tray of Object Grasping: a flat floor within four walls that lead whatever is dropped back to it."""

from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.solids import loft
from bulletarm_gym.simulation.shapes import BodySpec, Box, Piece

FLOOR_HEIGHT = 0.002
"""Height (m) of the floor's upper side."""
FLOOR_FRICTION = 0.5
RIM = 0.03
"""The floor is narrower by this (m) than the nominal size."""
FOOT = 0.015
"""Where (m beyond the floor's edge) the walls would meet the ground."""
WALL_HEIGHT = 0.1
"""Height (m) that the walls reach at 45 degrees."""
FILLET_SLOPE = 0.364
"""Slope (20 degrees) of the strip between floor and walls."""
THICKNESS = 0.008
COLOUR = (0.78, 0.78, 0.80, 1.0)


def tray_floor(size: float) -> BodySpec:
    """Return the floor of a tray of nominal side ``size`` (m), its frame on the ground in its middle.

    :param size: 0.25 in close loop, 0.33 in open loop
    """
    side = size - RIM
    piece = Piece(Box((side, side, FLOOR_HEIGHT)), Pose((0.0, 0.0, FLOOR_HEIGHT / 2.0)))
    return BodySpec("tray floor", (piece,), 0.0, FLOOR_FRICTION, colour=COLOUR)


def tray_walls(size: float) -> BodySpec:
    """Return the walls of a tray of nominal side ``size`` (m): without friction, so nothing leans on them."""
    inner = (size - RIM) / 2.0
    foot = inner + FOOT
    # The strip rises from the floor until the steeper wall overtakes it.
    meet = (foot - FILLET_SLOPE * inner + FLOOR_HEIGHT) / (1.0 - FILLET_SLOPE)
    top = foot + WALL_HEIGHT
    strip = ((inner, 0.0), (meet, 0.0), (meet, meet - foot), (inner, FLOOR_HEIGHT))
    panel = ((foot, 0.0), (foot + THICKNESS, 0.0), (top + THICKNESS, WALL_HEIGHT), (top, WALL_HEIGHT))
    pieces = [_side(section, turn) for section in (strip, panel) for turn in range(4)]
    return BodySpec("tray walls", tuple(pieces), 0.0, friction=0.0, colour=COLOUR)


def _side(section: tuple[tuple[float, float], ...], quarter: int) -> Piece:
    """Return one of four mitred sides; ``section`` gives distance from the middle and height (m)."""
    ends = [[(r, sign * r, z) for r, z in section] for sign in (1.0, -1.0)]
    corners = [[_turned(point, quarter) for point in end] for end in ends]
    return Piece(loft(corners))


def _turned(point: tuple[float, float, float], quarter: int) -> tuple[float, float, float]:
    """Turn a point by quarters about z, exactly."""
    x, y, z = point
    return ((x, y, z), (-y, x, z), (-x, -y, z), (y, -x, z))[quarter]
