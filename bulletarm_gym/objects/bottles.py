"""Solids of revolution: bottles, swabs and tubes."""

import math

from bulletarm_gym.geometry import Pose, Quaternion, Vector
from bulletarm_gym.objects.solids import Kind, Profile, corner_radius, lathe
from bulletarm_gym.simulation.shapes import BodySpec, Colour, Piece

BOTTLE_SIDES = 12
"""Corners of the polygon that approximates the circle of a bottle."""
BOTTLE_WIDTH = 0.0625
"""Nominal width (m) at scale 1 (paper, Bottle Arrangement: about 5 cm at scale 0.8)."""
BOTTLE_HEIGHT = 0.175
"""Nominal height (m) at scale 1 (paper, Bottle Arrangement: about 14 cm at scale 0.8)."""

BOTTLES: tuple[tuple[float, float, tuple[Profile, ...]], ...] = (
    (0.96, 1.05, (((0.94, 0.0), (1.0, 0.03), (1.0, 0.55), (0.42, 0.72)), ((0.42, 0.72), (0.42, 1.0)))),
    (1.0, 1.03, (((0.94, 0.0), (1.0, 0.03), (1.0, 0.6), (0.46, 0.7)), ((0.46, 0.7), (0.4, 1.0)))),
    (
        1.0,
        1.0,
        (
            ((0.9, 0.0), (1.0, 0.04), (1.0, 0.2), (0.82, 0.36)),
            ((0.82, 0.36), (1.0, 0.5), (1.0, 0.6), (0.44, 0.84)),
            ((0.44, 0.84), (0.44, 1.0)),
        ),
    ),
    (1.04, 0.96, (((0.96, 0.0), (1.0, 0.02), (1.0, 0.7), (0.52, 0.84)), ((0.6, 0.84), (0.6, 1.0)))),
    (1.02, 0.98, (((0.97, 0.0), (1.0, 0.06), (0.45, 0.8)), ((0.5, 0.8), (0.5, 1.0)))),
    (0.98, 1.0, (((0.88, 0.0), (1.0, 0.1), (0.96, 0.7), (0.7, 0.8)), ((0.6, 0.8), (0.34, 1.0)))),
    (1.0, 0.95, (((0.95, 0.0), (1.0, 0.03), (1.0, 0.78), (0.7, 0.84)), ((0.66, 0.84), (0.66, 1.0)))),
    (
        0.97,
        1.04,
        (
            ((0.94, 0.0), (1.0, 0.03), (0.86, 0.42)),
            ((0.86, 0.42), (0.9, 0.6), (0.4, 0.8)),
            ((0.46, 0.8), (0.46, 1.0)),
        ),
    ),
)
"""Relative width and height of the eight bottles, and the profiles of their convex parts.

A profile has radii relative to the largest one, and heights relative to the whole.
"""
BOTTLE_COLOURS: tuple[Colour, ...] = (
    (0.12, 0.42, 0.22, 1.0),
    (0.35, 0.1, 0.14, 1.0),
    (0.16, 0.13, 0.12, 1.0),
    (0.35, 0.65, 0.85, 1.0),
    (0.9, 0.75, 0.3, 1.0),
    (0.8, 0.16, 0.14, 1.0),
    (0.85, 0.85, 0.88, 1.0),
    (0.45, 0.72, 0.62, 1.0),
)
"""Colours of the eight bottles."""

COVID_SCALE = 0.6
"""Default scale of the Covid task, which gives the paper's sizes."""
SWAB: Vector = (0.07 / COVID_SCALE, 0.01 / COVID_SCALE, 0.01 / COVID_SCALE)
"""Bounding box (m) of a swab at scale 1 (paper, Covid Test: 7 x 1 x 1 cm)."""
TUBE: Vector = (0.08 / COVID_SCALE, 0.017 / COVID_SCALE, 0.017 / COVID_SCALE)
"""Bounding box (m) of a tube at scale 1 (paper, Covid Test: 8 x 1.7 x 1.7 cm)."""
ROLLING_DAMPING = 4.0
"""Angular damping that stops swabs and tubes, which have no rolling friction."""
ROD_SIDES = 8
"""Corners of the polygon that approximates the circle of swabs and tubes; few, so that they lie on a side."""
ALONG_X: Quaternion = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))
"""Rotation of the z axis to the x axis."""


def bottle(name: str, scale: float, number: int) -> BodySpec:
    """Return one of the eight bottles, upright, its frame at the middle of its height.

    :param number: 0 to 7
    """
    width, high, profiles = BOTTLES[number]
    radius, height = corner_radius(BOTTLE_WIDTH * width * scale, BOTTLE_SIDES), BOTTLE_HEIGHT * high * scale
    pieces = [
        lathe([(r * radius, (z - 0.5) * height) for r, z in profile], BOTTLE_SIDES) for profile in profiles
    ]
    return BodySpec(name, tuple(pieces), mass=0.2, colour=BOTTLE_COLOURS[number])


def _rod(thickness: float, profile: Profile) -> Piece:
    """Return a solid of revolution along x; the profile has radii relative to its thickness and x (m)."""
    radius = corner_radius(thickness, ROD_SIDES)
    points = [(share * radius, x) for share, x in profile]
    return lathe(points, ROD_SIDES, Pose((0.0, 0.0, 0.0), ALONG_X))


def _swab(scale: float) -> list[Piece]:
    length, thick = SWAB[0] * scale, SWAB[1] * scale
    tip = 0.28 * length
    return [
        _rod(thick, [(0.8, -tip / 2.0), (1.0, -tip / 4.0), (1.0, tip / 4.0), (0.8, tip / 2.0)]),
        _rod(0.38 * thick, [(1.0, tip / 2.0), (1.0, length - tip / 2.0)]),
    ]


def _tube(scale: float) -> list[Piece]:
    length, thick = TUBE[0] * scale, TUBE[1] * scale
    cap = 0.22 * length - length / 2.0
    return [
        _rod(thick, [(1.0, -length / 2.0), (1.0, cap)]),
        _rod(0.72 * thick, [(1.0, cap), (1.0, 0.48 * length), (0.6, 0.5 * length)]),
    ]


swab = Kind(_swab, 0.011, 2.0, (0.92, 0.92, 0.92, 1.0), ROLLING_DAMPING)
"""Swab along x: a rod with a heavy tip at -x, which contains the frame."""
tube = Kind(_tube, 0.11, colour=(0.30, 0.60, 0.62, 1.0), angular_damping=ROLLING_DAMPING)
"""Tube along x with a cap at -x, its frame at the middle of its length."""
used_tube = Kind(_tube, 0.11, colour=(0.85, 0.25, 0.22, 1.0), angular_damping=ROLLING_DAMPING)
"""Tube with a swab in it, which differs from the outside only by its colour."""
