"""Convex pieces by formula: lofts over rings of points, and what is made of them.

Every piece is a :class:`~bulletarm_gym.simulation.shapes.Convex` whose faces are known without a search for
the hull, so that a set of many objects is made in milliseconds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Mesh, Pose, Vector, quaternion
from bulletarm_gym.simulation.shapes import ORIGIN, Box, Convex, Piece

SIDES = 10
"""Corners of the polygons that stand for circles: even, so that opposite sides face each other."""
SECTORS = 8
"""Pieces that a hollow ring is cut into."""

Profile = Sequence[tuple[float, float]]
"""Radius and height (m) of the rings of a lathe, from the bottom up."""


def loft(rings: ArrayLike) -> Convex:
    """Return the solid between polygons stacked on one another.

    :param rings: (k, n, 3) corners (m), counter-clockwise seen from the last; the solid must be convex
    """
    points = np.asarray(rings, dtype=np.float64)
    count, corners, _ = points.shape
    faces = [(0, i + 1, i) for i in range(1, corners - 1)]
    last = (count - 1) * corners
    faces += [(last, last + i, last + i + 1) for i in range(1, corners - 1)]
    for ring in range(count - 1):
        for i in range(corners):
            low, next_low = ring * corners + i, ring * corners + (i + 1) % corners
            high, next_high = low + corners, next_low + corners
            faces += [(low, next_low, next_high), (low, next_high, high)]
    return Convex(Mesh.of(points.reshape(-1, 3), faces))


def circle(radius: float, height: float, sides: int = SIDES) -> FloatArray:
    """Return a regular polygon, (sides, 3), in the plane at ``height`` (m), two of its sides across y."""
    angles = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(sides, height)], axis=1)


def lathe(profile: Profile, sides: int = SIDES) -> Piece:
    """Return a solid of revolution about z whose profile bulges everywhere."""
    return Piece(loft([circle(radius, height, sides) for radius, height in profile]))


def stacked(*profiles: Profile) -> list[Piece]:
    """Return a solid of revolution in parts, each of which bulges: bottles, vases, spindles."""
    return [lathe(profile) for profile in profiles]


def extruded(outline: ArrayLike, height: float) -> Piece:
    """Return an upright prism over a convex outline, (n, 2) counter-clockwise (m), centred on z = 0."""
    plane = np.asarray(outline, dtype=np.float64)
    return Piece(loft([np.insert(plane, 2, z, axis=1) for z in (-height / 2.0, height / 2.0)]))


def beam(outline: ArrayLike, width: float) -> Piece:
    """Return a prism along x over a convex outline of y and z, (n, 2) counter-clockwise (m)."""
    plane = np.asarray(outline, dtype=np.float64)
    return Piece(loft([np.insert(plane, 0, x, axis=1) for x in (-width / 2.0, width / 2.0)]))


def corner_radius(width: float, sides: int) -> float:
    """Return the radius (m) of a regular polygon that is ``width`` (m) across, from side to side.

    With sides in multiples of four that is its bounding box, and what lies on one of them does not roll.
    """
    return width / 2.0 / math.cos(math.pi / sides)


def container(extents: Vector, wall: float, floor: float) -> tuple[Piece, ...]:
    """Return a box open to the top, its frame on the ground in its middle.

    :param extents: outer side lengths (m)
    :param wall: thickness (m) of the walls, which stand on the ground
    :param floor: thickness (m) of the floor between them
    """
    x, y, z = extents
    ends = [block((wall, y, z), (sign * (x - wall) / 2.0, 0.0, z / 2.0)) for sign in (1.0, -1.0)]
    inside = x - 2.0 * wall
    sides = [block((inside, wall, z), (0.0, sign * (y - wall) / 2.0, z / 2.0)) for sign in (1.0, -1.0)]
    return (*ends, *sides, block((inside, y - 2.0 * wall, floor), (0.0, 0.0, floor / 2.0)))


def block(extents: Vector, centre: Vector = (0.0, 0.0, 0.0)) -> Piece:
    """Return a box of full side lengths ``extents`` (m)."""
    return Piece(Box(extents), Pose(centre) if any(centre) else ORIGIN)


@dataclass(frozen=True)
class Wall:
    """One ring of a vessel's wall: its inner and outer radius at a height (m)."""

    inner: float
    outer: float
    height: float


def vessel(low: Wall, high: Wall, base: float, sectors: int = SECTORS) -> list[Piece]:
    """Return a vessel that is hollow: a disc ``base`` (m) thick and a wall in sectors, straight or flared."""
    bottom = lathe([(low.outer, low.height), (low.outer, low.height + base)], 2 * sectors)
    return [bottom, *ring(low, high, sectors)]


def ring(low: Wall, high: Wall, sectors: int = SECTORS) -> list[Piece]:
    """Return the sectors of a wall between two heights."""
    turns = [2.0 * math.pi * sector / sectors for sector in range(sectors + 1)]
    return [_sector(low, high, start, end) for start, end in pairwise(turns)]


def _sector(low: Wall, high: Wall, start: float, end: float) -> Piece:
    section = (
        (low.inner, low.height),
        (low.outer, low.height),
        (high.outer, high.height),
        (high.inner, high.height),
    )
    rings = [[(r * math.cos(turn), r * math.sin(turn), z) for r, z in section] for turn in (end, start)]
    return Piece(loft(rings))


def superquadric(semi_axes: Vector, roundness: tuple[float, float], levels: int = 6) -> Piece:
    """Return a superquadric: an ellipsoid at roundness (1, 1), more of a box towards 0.

    :param semi_axes: along x, y, z (m)
    :param roundness: exponents in the vertical and the horizontal plane, in (0, 1]
    :param levels: rings of points from pole to pole
    """
    a, b, c = semi_axes
    rings = []
    for latitude in np.linspace(-POLE, POLE, levels):
        radius, height = _power(math.cos(latitude), roundness[0]), _power(math.sin(latitude), roundness[0])
        turns = 2.0 * np.pi * (np.arange(SIDES + 2) + 0.5) / (SIDES + 2)
        rings.append(
            [
                (
                    a * radius * _power(math.cos(turn), roundness[1]),
                    b * radius * _power(math.sin(turn), roundness[1]),
                    c * height,
                )
                for turn in turns.tolist()
            ]
        )
    return Piece(loft(rings))


POLE = math.radians(72.0)
"""Latitude of the last ring: the poles are cut flat."""


def _power(value: float, exponent: float) -> float:
    return math.copysign(abs(value) ** exponent, value)


def settled(pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """Return the pieces in the frame their body lies in: z along its shortest side, y along its longest.

    The frame's origin is the middle of the bounding box.
    """
    vertices = np.concatenate([piece.mesh.vertices for piece in pieces])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    z, x, y = np.argsort(high - low, kind="stable").tolist()
    axes = np.eye(3)[[x, y, z]]
    axes[0] *= np.linalg.det(axes)
    middle = axes @ (low + high) / 2.0
    frame = Pose((-float(middle[0]), -float(middle[1]), -float(middle[2])), quaternion(axes))
    return tuple(Piece(Convex(piece.mesh.moved(frame))) for piece in pieces)
