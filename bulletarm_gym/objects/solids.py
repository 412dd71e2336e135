"""Convex pieces by formula, and bodies made of them.

The faces of each piece are known without a search for the convex hull, so that many objects are made in
milliseconds.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Mesh, Pose, Vector, quaternion
from bulletarm_gym.simulation.shapes import ORIGIN, RED, BodySpec, Box, Colour, Convex, Piece

SIDES = 10
"""Corners of the polygons that approximate circles; even, so that opposite sides are parallel."""
SECTORS = 8
"""Pieces of a hollow ring."""
POLE = math.radians(72.0)
"""Latitude (rad) of the first and last ring of a superquadric, whose poles are cut flat."""

Profile = Sequence[tuple[float, float]]
"""Radius and height (m) of the rings of a solid of revolution, from the bottom up."""
Ring = tuple[float, float, float]
"""Inner radius, outer radius and height (m) of a cross-section of a hollow wall."""


@dataclass(frozen=True)
class Kind:
    """Kind of object; a call ``kind(name, scale)`` returns its body, of equal mass at every scale.

    :param pieces: the pieces at scale 1, or a function that returns them at a scale
    """

    pieces: Sequence[Piece] | Callable[[float], Iterable[Piece]]
    mass: float
    friction: float = 1.0
    colour: Colour = RED
    angular_damping: float = 0.0

    def __call__(self, name: str, scale: float = 1.0) -> BodySpec:
        """Return the body at a scale."""
        made = self.pieces
        pieces = made(scale) if callable(made) else (piece.scaled(scale) for piece in made)
        damping, colour = self.angular_damping, self.colour
        return BodySpec(name, tuple(pieces), self.mass, self.friction, angular_damping=damping, colour=colour)


def block(extents: Vector, centre: Vector = (0.0, 0.0, 0.0)) -> Piece:
    """Return a box of full side lengths ``extents`` (m)."""
    return Piece(Box(extents), Pose(centre) if any(centre) else ORIGIN)


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


def prism(outline: ArrayLike, length: float, axis: int = 2) -> Piece:
    """Return a prism along an axis (0 for x, 2 for z), centred on the plane of its outline.

    :param outline: (n, 2) convex, counter-clockwise (m), along the other two axes
    """
    plane = np.asarray(outline, dtype=np.float64)
    return Piece(loft([np.insert(plane, axis, end, axis=1) for end in (-length / 2.0, length / 2.0)]))


def lathe(profile: Profile, sides: int = SIDES, pose: Pose = ORIGIN) -> Piece:
    """Return a solid of revolution about z with a convex profile, at a pose; two of its sides face y."""
    angles = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    rings = [
        np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(sides, height)], axis=1)
        for radius, height in profile
    ]
    return Piece(loft(rings), pose)


def cylinder(radius: float, length: float, sides: int = SIDES, pose: Pose = ORIGIN) -> Piece:
    """Return a cylinder along z, centred on its frame; ``radius`` (m) is that of its polygon's corners."""
    return lathe([(radius, -length / 2.0), (radius, length / 2.0)], sides, pose)


def corner_radius(width: float, sides: int) -> float:
    """Return the radius (m) of a regular polygon of ``width`` (m) from side to side.

    If the number of sides is a multiple of four, the width is that of the bounding box.
    """
    return width / 2.0 / math.cos(math.pi / sides)


def container(extents: Vector, wall: float, floor: float) -> tuple[Piece, ...]:
    """Return a box open to the top, its frame on the ground at its centre.

    :param extents: outer side lengths (m), of which walls and floor have a thickness (m)
    """
    x, y, z = extents
    ends = [block((wall, y, z), (sign * (x - wall) / 2.0, 0.0, z / 2.0)) for sign in (1.0, -1.0)]
    inside = x - 2.0 * wall
    sides = [block((inside, wall, z), (0.0, sign * (y - wall) / 2.0, z / 2.0)) for sign in (1.0, -1.0)]
    return (*ends, *sides, block((inside, y - 2.0 * wall, floor), (0.0, 0.0, floor / 2.0)))


def vessel(low: Ring, high: Ring, base: float, sectors: int = SECTORS) -> list[Piece]:
    """Return a hollow vessel: a disc ``base`` (m) thick and a straight or flared wall."""
    _, radius, height = low
    return [lathe([(radius, height), (radius, height + base)], 2 * sectors), *wall(low, high, sectors)]


def wall(low: Ring, high: Ring, sectors: int = SECTORS) -> list[Piece]:
    """Return the sectors of a wall between two rings."""
    (inner, outer, bottom), (top_inner, top_outer, top) = low, high
    section = ((inner, bottom), (outer, bottom), (top_outer, top), (top_inner, top))
    angles = [2.0 * math.pi * sector / sectors for sector in range(sectors + 1)]
    rings = [[(r * math.cos(angle), r * math.sin(angle), z) for r, z in section] for angle in angles]
    return [Piece(loft([end, start])) for start, end in pairwise(rings)]


def superquadric(semi_axes: Vector, roundness: tuple[float, float], levels: int = 6) -> Piece:
    """Return a superquadric: an ellipsoid at roundness (1, 1), similar to a box near 0.

    :param semi_axes: along x, y, z (m)
    :param roundness: exponents in the vertical and the horizontal plane, in (0, 1]
    :param levels: rings of points from pole to pole
    """
    (a, b, c), (vertical, horizontal) = semi_axes, roundness
    angles = (2.0 * np.pi * (np.arange(SIDES + 2) + 0.5) / (SIDES + 2)).tolist()
    rings = []
    for latitude in np.linspace(-POLE, POLE, levels):
        radius, height = _power(math.cos(latitude), vertical), _power(math.sin(latitude), vertical)
        outline = [
            (_power(math.cos(angle), horizontal), _power(math.sin(angle), horizontal)) for angle in angles
        ]
        rings.append([(a * radius * x, b * radius * y, c * height) for x, y in outline])
    return Piece(loft(rings))


def _power(value: float, exponent: float) -> float:
    return math.copysign(abs(value) ** exponent, value)


def laid_flat(pieces: Iterable[Piece]) -> tuple[Piece, ...]:
    """Return pieces in the resting frame of their body: z along its shortest side, y along its longest.

    The frame's origin is the centre of the bounding box.
    """
    meshes = [piece.mesh for piece in pieces]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    z, x, y = np.argsort(high - low, kind="stable").tolist()
    axes: FloatArray = np.eye(3)[[x, y, z]]
    axes[0] *= np.linalg.det(axes)
    middle = axes @ (low + high) / 2.0
    frame = Pose((-float(middle[0]), -float(middle[1]), -float(middle[2])), quaternion(axes))
    return tuple(Piece(Convex(mesh.moved(frame))) for mesh in meshes)
