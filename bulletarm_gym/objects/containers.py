"""Containers and fixtures: bowl, trays, bin, pallet, boxes of the Covid test, corner and drawer.

All but the bowl are fixed, and their frame is on the ground at their centre.
"""

import math

from bulletarm_gym.geometry import Pose, Quaternion, Vector
from bulletarm_gym.objects.solids import (
    Kind,
    Profile,
    block,
    container,
    corner_radius,
    cylinder,
    lathe,
    loft,
    vessel,
    wall,
)
from bulletarm_gym.simulation.shapes import YELLOW, BodySpec, Colour, Piece, Slide

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
    """Return one of the eight bottles, by its number from 0, its frame at the middle of its height."""
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


GREY: Colour = (0.78, 0.78, 0.80, 1.0)
"""Colour of most fixtures."""

BOWL_DIAMETER = 0.16
"""Diameter (m) of the bowl at scale 1 (paper, Block in Bowl)."""
BOWL_HEIGHT = 0.07
"""Height (m) of the bowl at scale 1 (paper, Block in Bowl)."""
BOWL_THICKNESS = 0.006
"""Thickness (m) of the bowl's wall and base."""


def _bowl(scale: float) -> list[Piece]:
    """Return the pieces between foot, belly and rim. A cube of 5 cm lies flat inside the foot."""
    sectors = 12  # a multiple of 4, so that the bounding box is as wide as the circle
    foot, belly, rim = (
        ((radius - BOWL_THICKNESS) * scale, radius * scale, (height - BOWL_HEIGHT / 2.0) * scale)
        for radius, height in ((0.048, 0.0), (0.072, 0.03), (BOWL_DIAMETER / 2.0, BOWL_HEIGHT))
    )
    return [*vessel(foot, belly, BOWL_THICKNESS * scale, sectors), *wall(belly, rim, sectors)]


bowl = Kind(_bowl, mass=0.1, colour=YELLOW)
"""Bowl that is open to the top, its frame on its axis at the middle of its height."""

TRAY: Vector = (0.24, 0.16, 0.05)
"""Outer side lengths (m) of the tray for bottles (paper, Bottle Arrangement)."""
TRAY_WALL = 0.01
"""Thickness (m) of its walls."""
TRAY_FLOOR = 0.005
"""Thickness (m) of its floor."""
BIN: Vector = (0.176, 0.144, 0.08)
"""Outer side lengths (m) of the bin (paper, Bin Packing)."""
BIN_WALL = 0.004
"""Thickness (m) of its walls and floor."""
NEW_TUBE_BOX: Vector = (0.17, 0.2, 0.005)
"""Outer side lengths (m) of the box for new swabs and tubes."""
USED_TUBE_BOX: Vector = (0.12, 0.1, 0.04)
"""Outer side lengths (m) of the box for used tubes."""
TEST_AREA: Vector = (0.125, 0.3, 0.01)
"""Outer side lengths (m) of the area for the test of a swab and a tube."""
BOX_WALL, BOX_FLOOR = 0.004, 0.002
"""Thickness (m) of the walls and of the floor of these three."""
PALLET: Vector = (0.232, 0.192, 0.03)
"""Side lengths (m) of the pallet (paper, Box Palletizing)."""


def _pallet() -> list[Piece]:
    """Return six boards along y on three bearers along x."""
    (x, y, z), board_width, board_height, bearer_width = PALLET, 0.028, 0.008, 0.02
    pitch, across = (x - board_width) / 5, (y - bearer_width) / 2
    bearer_height = z - board_height
    boards = [(number - 2.5) * pitch for number in range(6)]
    bearers = [(number - 1.0) * across for number in range(3)]
    return [
        *(block((board_width, y, board_height), (at, 0.0, z - board_height / 2.0)) for at in boards),
        *(block((x, bearer_width, bearer_height), (0.0, at, bearer_height / 2.0)) for at in bearers),
    ]


bottle_tray = Kind(container(TRAY, TRAY_WALL, TRAY_FLOOR), 0.0, colour=(0.80, 0.80, 0.82, 1.0))
"""Tray for bottles, long along x."""
packing_bin = Kind(container(BIN, BIN_WALL, BIN_WALL), 0.0, colour=GREY)
"""Bin, long along x."""
new_tube_box = Kind(container(NEW_TUBE_BOX, BOX_WALL, BOX_FLOOR), 0.0, colour=(0.70, 0.62, 0.85, 1.0))
"""Box for new swabs and tubes."""
test_area = Kind(container(TEST_AREA, BOX_WALL, BOX_FLOOR), 0.0, colour=(0.72, 0.72, 0.74, 1.0))
"""Area for the test of a swab and a tube."""
used_tube_box = Kind(container(USED_TUBE_BOX, BOX_WALL, BOX_FLOOR), 0.0, colour=(0.90, 0.82, 0.25, 1.0))
"""Box for used tubes."""
pallet = Kind(_pallet(), 0.0, colour=(0.82, 0.66, 0.44, 1.0))
"""Pallet, long along x."""

# The corner of Corner Picking

CORNER_SIDE = 0.2
"""Side (m) of the corner's plate and walls."""
CORNER_PLATE = 0.01
"""Thickness (m) of the plate. A finger would push a block through a thinner one onto the ground."""
CORNER_INSIDE = -0.09
"""Position (m) along x and y of the walls' inner faces in the corner's frame."""


def _corner() -> list[Piece]:
    # The Panda, whose gripper is the widest, reaches the cube over this height, and cannot grasp such thick
    # walls together with the cube.
    side, height, thick = CORNER_SIDE, 0.09, 0.03
    middle = CORNER_INSIDE - thick / 2.0
    return [
        block((side, side, CORNER_PLATE), (0.0, 0.0, CORNER_PLATE / 2.0)),
        block((thick, side, height), (middle, 0.0, height / 2.0)),
        block((side, thick, height), (0.0, middle, height / 2.0)),
    ]


corner = Kind(_corner(), 0.0, 0.2, GREY)
"""Two walls on a plate, open towards +x and +y; a finger pressed on a block can drag it over the plate."""

# The drawer of Drawer Opening

CABINET: Vector = (0.213, 0.228, 0.108)
"""Side lengths (m) of the cabinet."""
CABINET_WALL = 0.006
"""Thickness (m) of all walls of cabinet and drawer."""
FRONT = -CABINET[0] / 2.0
"""Position (m) along x of the front of the closed drawer in the cabinet's frame."""
HANDLE_DISTANCE = 0.05
"""Distance (m) of the handle's bar from the drawer's front."""
HANDLE_RADIUS = 0.0075
"""Radius (m) of the bar."""
STRUT_SPACING = 0.07
"""Distance (m) between the two struts of the bar."""
HANDLE: Vector = (FRONT - HANDLE_DISTANCE, 0.0, 0.054)
"""Centre (m) of the bar of the closed drawer in the cabinet's frame."""


def drawer(name: str) -> BodySpec:
    """Return a cabinet whose drawer opens towards -x, its frame on the ground at the cabinet's centre."""
    slide = Slide(
        "drawer",
        (*_drawer(), *_handle()),
        mass=0.35,
        axis=(-1.0, 0.0, 0.0),
        limits=(0.0, 0.18),
        resistance=1.0,
        colour=(0.45, 0.46, 0.50, 1.0),
    )
    return BodySpec(name, _cabinet(), 0.0, colour=GREY, parts=(slide,))


def _cabinet() -> tuple[Piece, ...]:
    (x, y, z), thick = CABINET, CABINET_WALL
    sides = [block((x, thick, z), (0.0, sign * (y - thick) / 2.0, z / 2.0)) for sign in (1.0, -1.0)]
    plates = [block((x, y, thick), (0.0, 0.0, height)) for height in (thick / 2.0, z - thick / 2.0)]
    return (*sides, *plates, block((thick, y, z), ((x - thick) / 2.0, 0.0, z / 2.0)))


def _drawer() -> tuple[Piece, ...]:
    (x, y, z), thick = (0.2, 0.21, 0.09), CABINET_WALL
    middle, low, inset = FRONT + x / 2.0, (CABINET[2] - z) / 2.0, thick / 2.0
    height = low + z / 2.0
    ends = [block((thick, y, z), (end, 0.0, height)) for end in (FRONT + inset, FRONT + x - inset)]
    sides = [block((x, thick, z), (middle, sign * (y - thick) / 2.0, height)) for sign in (1.0, -1.0)]
    return (*ends, *sides, block((x, y, thick), (middle, 0.0, low + thick / 2.0)))


def _handle() -> tuple[Piece, ...]:
    middle, height = FRONT - HANDLE_DISTANCE / 2.0, HANDLE[2]
    ends = [(middle, sign * STRUT_SPACING / 2.0, height) for sign in (1.0, -1.0)]
    struts = [cylinder(0.005, HANDLE_DISTANCE, pose=Pose(end, ALONG_X)) for end in ends]
    along_y = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    return (cylinder(HANDLE_RADIUS, 0.1, pose=Pose(HANDLE, along_y)), *struts)


# The tray of Object Grasping: a flat floor within four walls that lead dropped objects back to it

FLOOR_HEIGHT = 0.002
"""Height (m) of the upper side of the floor."""
RIM = 0.03
"""Difference (m) between the nominal side of the tray and that of its floor."""
WALL_HEIGHT = 0.1
"""Height (m) of the walls, which have a slope of 45 degrees."""
FILLET_SLOPE = 0.364
"""Slope (20 degrees) of the strip between floor and walls."""


def tray_floor(size: float) -> BodySpec:
    """Return the floor of a tray of nominal side ``size`` (m): 0.25 in closed loop, 0.33 in open loop."""
    piece = block((size - RIM, size - RIM, FLOOR_HEIGHT), (0.0, 0.0, FLOOR_HEIGHT / 2.0))
    return BodySpec("tray floor", (piece,), 0.0, friction=0.5, colour=GREY)


def tray_walls(size: float) -> BodySpec:
    """Return the walls of a tray of nominal side ``size`` (m), without friction, so that objects slide."""
    # The walls would meet the ground at foot. The strip rises from the floor until it meets the wall.
    inner, thickness = (size - RIM) / 2.0, 0.008
    foot = inner + 0.015
    meet = (foot - FILLET_SLOPE * inner + FLOOR_HEIGHT) / (1.0 - FILLET_SLOPE)
    top = foot + WALL_HEIGHT
    strip = ((inner, 0.0), (meet, 0.0), (meet, meet - foot), (inner, FLOOR_HEIGHT))
    panel = ((foot, 0.0), (foot + thickness, 0.0), (top + thickness, WALL_HEIGHT), (top, WALL_HEIGHT))
    pieces = [_side(section, quarter) for section in (strip, panel) for quarter in range(4)]
    return BodySpec("tray walls", tuple(pieces), 0.0, friction=0.0, colour=GREY)


def _side(section: tuple[tuple[float, float], ...], quarter: int) -> Piece:
    """Return one of four mitred sides; ``section`` has the distance from the centre and the height (m)."""
    ends = [[(r, sign * r, z) for r, z in section] for sign in (1.0, -1.0)]
    # Quarter turns about z without rounding.
    return Piece(
        loft([[((x, y, z), (-y, x, z), (-x, -y, z), (y, -x, z))[quarter] for x, y, z in end] for end in ends])
    )
