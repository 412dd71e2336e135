"""Swabs, tubes and the three places of a test (paper, Covid Test).

Swabs and tubes lie along x. Places do not scale; their frames are on the ground in their middle.
"""

import math

from bulletarm_gym.geometry import Pose, Quaternion, Vector
from bulletarm_gym.objects.solids import Profile, container, corner_radius, lathe
from bulletarm_gym.simulation.shapes import BodySpec, Colour, Piece

SCALE = 0.6
"""Default scale of the task: gives exactly the paper's sizes."""
SWAB: Vector = (0.07 / SCALE, 0.01 / SCALE, 0.01 / SCALE)
TUBE: Vector = (0.08 / SCALE, 0.017 / SCALE, 0.017 / SCALE)
"""Bounding boxes (m) at scale 1: 7 x 1 x 1 cm and 8 x 1.7 x 1.7 cm at 0.6 (paper, Covid Test)."""
TIP = 0.28
"""Share of a swab's length that is its thick tip ..."""
ROD = 0.38
"""... and the rod's thickness in shares of the tip's."""
CAP = 0.22
"""Share of a tube's length that is its cap ..."""
GLASS = 0.72
"""... and the tube's thickness in shares of the cap's."""
SWAB_MASS = 0.011
TUBE_MASS = 0.11
SWAB_FRICTION = 2.0
"""Masses (kg) and friction. There is no rolling friction; angular damping stops what rolls."""
ANGULAR_DAMPING = 4.0
SIDES = 8
"""Few, so that they lie on a side."""

NEW_TUBE_BOX: Vector = (0.17, 0.2, 0.005)
TEST_AREA: Vector = (0.125, 0.3, 0.01)
USED_TUBE_BOX: Vector = (0.12, 0.1, 0.04)
"""Outer side lengths (m): a tube of the paper's length fits in both ways."""
WALL = 0.004
BOX_FLOOR = 0.002
PURPLE: Colour = (0.70, 0.62, 0.85, 1.0)
GREY: Colour = (0.72, 0.72, 0.74, 1.0)
YELLOW: Colour = (0.90, 0.82, 0.25, 1.0)
WHITE: Colour = (0.92, 0.92, 0.92, 1.0)
RED: Colour = (0.85, 0.25, 0.22, 1.0)
TEAL: Colour = (0.30, 0.60, 0.62, 1.0)

ALONG_X: Quaternion = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))


def swab(name: str, scale: float) -> BodySpec:
    """Return a swab: a rod with a thick tip at -x. Its frame is in the tip, where it is heavy."""
    length, thick = SWAB[0] * scale, SWAB[1] * scale
    tip = TIP * length
    pieces = (
        _rod(thick, [(0.8, -tip / 2.0), (1.0, -tip / 4.0), (1.0, tip / 4.0), (0.8, tip / 2.0)]),
        _rod(ROD * thick, [(1.0, tip / 2.0), (1.0, length - tip / 2.0)]),
    )
    return BodySpec(name, pieces, SWAB_MASS, SWAB_FRICTION, angular_damping=ANGULAR_DAMPING, colour=WHITE)


def tube(name: str, scale: float) -> BodySpec:
    """Return a tube with a cap at -x, its frame in the middle of its length."""
    return _tube(name, scale, TEAL)


def used_tube(name: str, scale: float) -> BodySpec:
    """Return a tube with a swab in it: the same from outside but for its colour."""
    return _tube(name, scale, RED)


def _tube(name: str, scale: float, colour: Colour) -> BodySpec:
    length, thick = TUBE[0] * scale, TUBE[1] * scale
    cap = CAP * length - length / 2.0
    pieces = (
        _rod(thick, [(1.0, -length / 2.0), (1.0, cap)]),
        _rod(GLASS * thick, [(1.0, cap), (1.0, 0.48 * length), (0.6, 0.5 * length)]),
    )
    return BodySpec(name, pieces, TUBE_MASS, angular_damping=ANGULAR_DAMPING, colour=colour)


def _rod(thickness: float, profile: Profile) -> Piece:
    """Return a solid of revolution along x; the profile gives shares of its thickness and x (m)."""
    radius = corner_radius(thickness, SIDES)
    return Piece(
        lathe([(share * radius, x) for share, x in profile], SIDES).shape, Pose((0.0, 0.0, 0.0), ALONG_X)
    )


def new_tube_box(name: str, scale: float = 1.0) -> BodySpec:
    """Return the place where new swabs and tubes lie."""
    return _place(name, NEW_TUBE_BOX, scale, PURPLE)


def test_area(name: str, scale: float = 1.0) -> BodySpec:
    """Return the place where a pair of swab and tube is tested."""
    return _place(name, TEST_AREA, scale, GREY)


def used_tube_box(name: str, scale: float = 1.0) -> BodySpec:
    """Return the place for used tubes."""
    return _place(name, USED_TUBE_BOX, scale, YELLOW)


def _place(name: str, extents: Vector, scale: float, colour: Colour) -> BodySpec:
    pieces = tuple(piece.scaled(scale) for piece in container(extents, WALL, BOX_FLOOR))
    return BodySpec(name, pieces, 0.0, colour=colour)
