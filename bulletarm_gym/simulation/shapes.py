"""Specifications of bodies: convex pieces with mass, friction and colour."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from bulletarm_gym.geometry import FloatArray, Mesh, Pose, Vector, join, mass_properties

Colour: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1."""

ORIGIN = Pose((0.0, 0.0, 0.0))

RED: Colour = (0.84, 0.15, 0.16, 1.0)
BLUE: Colour = (0.13, 0.35, 0.75, 1.0)
YELLOW: Colour = (0.95, 0.80, 0.10, 1.0)


@dataclass(frozen=True)
class Box:
    """A box of full side lengths ``extents`` (m), centred on its frame."""

    extents: Vector

    @property
    def mesh(self) -> Mesh:
        """The box's triangles in its frame."""
        return Mesh.box(self.extents)


@dataclass(frozen=True)
class Convex:
    """The convex hull of a mesh's vertices. Only a convex mesh is rendered as it collides."""

    mesh: Mesh


Shape: TypeAlias = Box | Convex


@dataclass(frozen=True)
class Piece:
    """A convex shape at a pose in its body's frame."""

    shape: Shape
    pose: Pose = ORIGIN

    @property
    def mesh(self) -> Mesh:
        """The piece's triangles in the body's frame."""
        return self.shape.mesh if self.pose == ORIGIN else self.shape.mesh.moved(self.pose)

    def scaled(self, factor: float) -> "Piece":
        """Return the piece of a body ``factor`` times as large."""
        pose = self.pose._replace(position=_scaled(self.pose.position, factor))
        if isinstance(self.shape, Box):
            return Piece(Box(_scaled(self.shape.extents, factor)), pose)
        mesh = self.shape.mesh
        return Piece(Convex(Mesh.of(mesh.vertices * factor, mesh.faces)), pose)


@dataclass(frozen=True)
class MovingPart:
    """A part of a body on a joint. Its pieces are in the body's frame, with the joint at 0.

    :param name: unique in the body
    :param mass: kg
    :param axis: unit vector of the joint in the body's frame
    :param limits: minimum and maximum joint position (m or rad)
    :param friction: lateral friction coefficient of the surface
    :param resistance: force (N) or torque (N m) that brakes the joint
    """

    name: str
    pieces: tuple[Piece, ...]
    mass: float
    axis: Vector
    limits: tuple[float, float]
    friction: float = 1.0
    resistance: float = 0.0
    colour: Colour = RED

    @property
    def mesh(self) -> Mesh:
        """The triangles of all pieces in the body's frame, with the joint at 0."""
        return join([piece.mesh for piece in self.pieces])


@dataclass(frozen=True)
class Slide(MovingPart):
    """A part that slides along an axis of the body's frame."""

    def moved(self, distance: float) -> Pose:
        """Return the pose in the body's frame of the body's origin, displaced with the part (m)."""
        return Pose(_scaled(self.axis, distance))


@dataclass(frozen=True)
class Hinge(MovingPart):
    """A part that rotates about an axis of the body's frame, counter-clockwise for positive angles.

    :param pivot: a point (m) on the axis, in the body's frame
    """

    pivot: Vector = ORIGIN.position

    def moved(self, angle: float) -> Pose:
        """Return the pose in the body's frame of the body's origin, rotated with the part (rad)."""
        x, y, z = (part * math.sin(angle / 2.0) for part in self.axis)
        rotated = Pose(self.pivot, (x, y, z, math.cos(angle / 2.0)))
        return rotated.compose(Pose(self.pivot).inverse())


@dataclass(frozen=True)
class BodySpec:
    """Specification of a body.

    :param name: unique in the scene
    :param pieces: convex pieces that collide and are rendered
    :param mass: kg; 0 fixes the body to the world
    :param friction: lateral friction coefficient; Bullet multiplies the coefficients of two bodies in contact
    :param rolling_friction: coefficient against rolling (m)
    :param spinning_friction: coefficient against spinning in place (m)
    :param angular_damping: fraction of the angular velocity lost per second, added to the physics mode's
    :param slides: parts that slide; their joints come first
    :param hinges: parts that rotate; their joints follow
    :param is_mark: a mark on the ground, which is rendered but is not an obstacle and has no height
    """

    name: str
    pieces: tuple[Piece, ...]
    mass: float
    friction: float = 1.0
    rolling_friction: float = 0.0
    spinning_friction: float = 0.0
    angular_damping: float = 0.0
    colour: Colour = RED
    slides: tuple[Slide, ...] = ()
    hinges: tuple[Hinge, ...] = ()
    is_mark: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if a number is negative or not finite, or the colour is not four numbers."""
        for name in ("mass", "friction", "rolling_friction", "spinning_friction", "angular_damping"):
            if not 0.0 <= (value := getattr(self, name)) < math.inf:
                raise ValueError(
                    f"{name} of {self.name!r} must be a finite number of at least 0, got {value}"
                )
        if len(self.colour) != 4:
            raise ValueError(f"colour of {self.name!r} must be red, green, blue and alpha, got {self.colour}")

    @cached_property
    def mesh(self) -> Mesh:
        """The triangles of all pieces in the body's frame."""
        return join([piece.mesh for piece in self.pieces])

    @property
    def parts(self) -> tuple[Slide | Hinge, ...]:
        """The moving parts in the order of the joints."""
        return (*self.slides, *self.hinges)

    @cached_property
    def part_meshes(self) -> list[Mesh]:
        """Meshes of the body and of its moving parts."""
        return [self.mesh, *(part.mesh for part in self.parts)]

    @cached_property
    def piece_bounds(self) -> FloatArray:
        """Bounding box of each piece in the body's frame, (n, 2, 3) m."""
        return np.stack([piece.mesh.bounds for piece in self.pieces])

    @cached_property
    def extents(self) -> Vector:
        """Full side lengths (m) of the bounding box in the body's frame."""
        low, high = self.mesh.bounds
        x, y, z = (high - low).tolist()
        return (x, y, z)

    @cached_property
    def planar_radius(self) -> float:
        """Maximum distance (m) of the body from the frame's z axis."""
        return float(np.linalg.norm(self.mesh.vertices[:, :2], axis=1).max())

    @cached_property
    def radius(self) -> float:
        """Maximum distance (m) of the body, without moving parts, from the frame's origin."""
        return float(np.linalg.norm(self.mesh.vertices, axis=1).max()) if self.pieces else 0.0

    @cached_property
    def mass_properties(self) -> tuple[Pose, Vector]:
        """Principal frame at the centre of mass and inertia (kg m^2) about its axes."""
        only_box = len(self.pieces) == 1 and isinstance(self.pieces[0].shape, Box)
        if self.mass == 0.0 or (only_box and self.pieces[0].pose == ORIGIN):
            x, y, z = (side * side for side in self.extents)
            factor = self.mass / 12.0
            return ORIGIN, (factor * (y + z), factor * (x + z), factor * (x + y))
        return mass_properties([piece.mesh for piece in self.pieces], self.mass)


def _scaled(vector: Vector, factor: float) -> Vector:
    x, y, z = vector
    return (x * factor, y * factor, z * factor)


def wavefront(pieces: Sequence[Piece]) -> str:
    """Return the pieces as the text of an OBJ file. Bullet makes one convex hull of each named part."""
    lines, count = [], 1
    for number, mesh in enumerate(piece.mesh for piece in pieces):
        lines.append(f"o piece_{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
        lines += [f"f {a + count} {b + count} {c + count}" for a, b, c in mesh.faces.tolist()]
        count += len(mesh.vertices)
    return "\n".join(lines) + "\n"


def flat_normals(triangles: FloatArray) -> list[list[float]]:
    """Return a normal for each corner of (n, 3, 3) triangles, so that edges are rendered sharp."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corners: list[list[float]] = np.repeat(normals, 3, axis=0).tolist()
    return corners
