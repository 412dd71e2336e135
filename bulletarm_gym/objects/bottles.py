"""Eight bottles and the tray they are arranged in (paper, Bottle Arrangement)."""

from bulletarm_gym.objects.solids import Profile, container, corner_radius, lathe
from bulletarm_gym.simulation.shapes import BodySpec, Colour

MASS = 0.2
"""Mass (kg) of an empty bottle: a heavier one slips in a light grip."""
FRICTION = 1.0
"""The pads hold a neck by their own friction; more would make grips spring."""
SIDES = 12
TRAY = (0.24, 0.16, 0.05)
"""Outer side lengths (m; paper, Bottle Arrangement); the tray does not scale."""
TRAY_WALL = 0.01
TRAY_FLOOR = 0.005
GREY: Colour = (0.80, 0.80, 0.82, 1.0)

WIDTH = 0.0625
HEIGHT = 0.175
"""At scale 1 (m): about 5 x 5 x 14 cm at the default scale of 0.8 (paper, Bottle Arrangement)."""

BOTTLES: tuple[tuple[float, float, Colour, tuple[Profile, ...]], ...] = (
    (
        0.96,
        1.05,
        (0.12, 0.42, 0.22, 1.0),
        (((0.94, 0.0), (1.0, 0.03), (1.0, 0.55), (0.42, 0.72)), ((0.42, 0.72), (0.42, 1.0))),
    ),
    (
        1.0,
        1.03,
        (0.35, 0.10, 0.14, 1.0),
        (((0.94, 0.0), (1.0, 0.03), (1.0, 0.60), (0.46, 0.70)), ((0.46, 0.70), (0.40, 1.0))),
    ),
    (
        1.0,
        1.0,
        (0.16, 0.13, 0.12, 1.0),
        (
            ((0.9, 0.0), (1.0, 0.04), (1.0, 0.2), (0.82, 0.36)),
            ((0.82, 0.36), (1.0, 0.5), (1.0, 0.6), (0.44, 0.84)),
            ((0.44, 0.84), (0.44, 1.0)),
        ),
    ),
    (
        1.04,
        0.96,
        (0.35, 0.65, 0.85, 1.0),
        (((0.96, 0.0), (1.0, 0.02), (1.0, 0.7), (0.52, 0.84)), ((0.6, 0.84), (0.6, 1.0))),
    ),
    (
        1.02,
        0.98,
        (0.90, 0.75, 0.30, 1.0),
        (((0.97, 0.0), (1.0, 0.06), (0.45, 0.8)), ((0.5, 0.8), (0.5, 1.0))),
    ),
    (
        0.98,
        1.0,
        (0.80, 0.16, 0.14, 1.0),
        (((0.88, 0.0), (1.0, 0.1), (0.96, 0.7), (0.7, 0.8)), ((0.6, 0.8), (0.34, 1.0))),
    ),
    (
        1.0,
        0.95,
        (0.85, 0.85, 0.88, 1.0),
        (((0.95, 0.0), (1.0, 0.03), (1.0, 0.78), (0.7, 0.84)), ((0.66, 0.84), (0.66, 1.0))),
    ),
    (
        0.97,
        1.04,
        (0.45, 0.72, 0.62, 1.0),
        (
            ((0.94, 0.0), (1.0, 0.03), (0.86, 0.42)),
            ((0.86, 0.42), (0.9, 0.6), (0.4, 0.8)),
            ((0.46, 0.8), (0.46, 1.0)),
        ),
    ),
)
"""Width and height in shares of the nominal, colour, and the outlines of the parts: half widths in shares of
the largest, heights in shares of the whole. Each part bulges everywhere."""


def bottle(name: str, scale: float, number: int) -> BodySpec:
    """Return one of the eight bottles, upright, its frame in the middle of its height.

    :param number: 0 to 7
    """
    wide, high, colour, outlines = BOTTLES[number]
    radius, height = corner_radius(WIDTH * wide * scale, SIDES), HEIGHT * high * scale
    pieces = [lathe([(r * radius, (z - 0.5) * height) for r, z in outline], SIDES) for outline in outlines]
    return BodySpec(name, tuple(pieces), MASS, FRICTION, colour=colour)


def bottle_tray(name: str, scale: float = 1.0) -> BodySpec:
    """Return the tray, fixed where it is put, long along x, its frame on the ground in its middle."""
    pieces = tuple(piece.scaled(scale) for piece in container(TRAY, TRAY_WALL, TRAY_FLOOR))
    return BodySpec(name, pieces, 0.0, colour=GREY)
