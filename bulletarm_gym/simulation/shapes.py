"""Specifications of bodies: convex pieces with mass, friction and colour."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.config_checks import Check, check_fields, colour, instance, instances, numbers, rule
from bulletarm_gym.geometry import FloatArray, Mesh, Pose, Vector, join, mass_properties
from bulletarm_gym.geometry.poses import UNIT_TOLERANCE, pose_check, scaled

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

    def __post_init__(self) -> None:
        check_fields(self, {"extents": numbers("non-negative", 3)})

    @property
    def mesh(self) -> Mesh:
        """The box's triangles in its frame."""
        return Mesh.box(self.extents)


@dataclass(frozen=True)
class Convex:
    """The convex hull of a mesh's vertices. Only a convex mesh is rendered as it collides."""

    mesh: Mesh

    def __post_init__(self) -> None:
        check_fields(self, {"mesh": instance(Mesh)})


Shape: TypeAlias = Box | Convex


@dataclass(frozen=True)
class Piece:
    """A convex shape at a pose in its body's frame."""

    shape: Shape
    pose: Pose = ORIGIN

    def __post_init__(self) -> None:
        check_fields(self, {"shape": instance(Box, Convex), "pose": pose_check})

    @property
    def mesh(self) -> Mesh:
        """The piece's triangles in the body's frame."""
        return self.shape.mesh if self.pose == ORIGIN else self.shape.mesh.moved(self.pose)

    def scaled(self, factor: float) -> "Piece":
        """Return the piece of a body ``factor`` times as large."""
        pose = self.pose._replace(position=scaled(self.pose.position, factor))
        if isinstance(self.shape, Box):
            return Piece(Box(scaled(self.shape.extents, factor)), pose)
        mesh = self.shape.mesh
        return Piece(Convex(Mesh.of(mesh.vertices * factor, mesh.faces)), pose)


PIECES = instances(Piece, "pieces")
"""Check of the pieces of a body."""
AXIS = rule("a unit vector", lambda v: abs(math.hypot(*v) - 1.0) < UNIT_TOLERANCE, numbers(count=3))
"""Check of the axis of a joint."""
LIMITS = rule("[low, high] in ascending order", lambda ends: ends[0] <= ends[1], numbers(count=2))
"""Check of the limits of a joint."""
FRICTIONS = ("friction", "rolling_friction", "spinning_friction")
"""Names of the friction coefficients of a body."""


def amounts(*names: str) -> dict[str, Check]:
    """Return the check of non-negative numbers for each of some names."""
    return dict.fromkeys(names, numbers("non-negative"))


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

    def __post_init__(self) -> None:
        checks = {"pieces": PIECES, "axis": AXIS, "limits": LIMITS, "colour": colour}
        check_fields(self, {**checks, **amounts("mass", "friction", "resistance")})

    @property
    def mesh(self) -> Mesh:
        """The triangles of all pieces in the body's frame, with the joint at 0."""
        return join([piece.mesh for piece in self.pieces])


@dataclass(frozen=True)
class Slide(MovingPart):
    """A part that slides along an axis of the body's frame."""

    def moved(self, distance: float) -> Pose:
        """Return the pose in the body's frame of the body's origin, displaced with the part (m)."""
        return Pose(scaled(self.axis, distance))


@dataclass(frozen=True)
class Hinge(MovingPart):
    """A part that rotates about an axis of the body's frame, counter-clockwise for positive angles.

    :param pivot: a point (m) on the axis, in the body's frame
    """

    pivot: Vector = ORIGIN.position

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, {"pivot": numbers(count=3)})

    def moved(self, angle: float) -> Pose:
        """Return the pose in the body's frame of the body's origin, rotated with the part (rad)."""
        rotation = (*scaled(self.axis, math.sin(angle / 2.0)), math.cos(angle / 2.0))
        rotated = Pose(self.pivot, rotation)
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
    :param parts: moving parts in the order of the joints
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
    parts: tuple[Slide | Hinge, ...] = ()
    is_mark: bool = False

    def __post_init__(self) -> None:
        checks = {"pieces": PIECES, "parts": instances((Slide, Hinge), "slides and hinges"), "colour": colour}
        numbers = amounts("mass", *FRICTIONS, "angular_damping")
        check_fields(self, {**checks, **numbers}, f" of {self.name!r}")

    @cached_property
    def mesh(self) -> Mesh:
        """The triangles of all pieces in the body's frame."""
        return join([piece.mesh for piece in self.pieces])

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


def wavefront(pieces: Sequence[Piece]) -> str:
    """Return the pieces as the text of an OBJ file. Bullet makes one convex hull of each named part."""
    lines, count = [], 1
    for number, mesh in enumerate(piece.mesh for piece in pieces):
        lines.append(f"o piece_{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
        lines += [f"f {a + count} {b + count} {c + count}" for a, b, c in mesh.faces.tolist()]
        count += len(mesh.vertices)
    return "\n".join(lines) + "\n"


STL_HEADER, STL_FACET = 84, 50
"""Number of bytes before the first facet of a binary STL file, and of each facet."""
VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
"""Vertex of an ASCII STL file."""


def check_mesh(path: Path) -> None:
    """Raise ValueError with the file and the reason if a mesh cannot be loaded."""
    try:
        (_check_collada if path.suffix.lower() == ".dae" else mesh_parts)(path)
    except (ValueError, OSError, ElementTree.ParseError) as error:
        raise ValueError(f"mesh must be a readable OBJ, STL or COLLADA file, got {path}: {error}") from error


def mesh_parts(path: Path) -> list[tuple[str, FloatArray]]:
    """Return the parts of an OBJ file that have faces, or the only part of an STL file.

    :return: name of each part and the corners (3 n, 3) of its triangles in the unit of the file
    :raises ValueError: the file has no faces, a face has a vertex that does not exist, or one is not finite
    :raises OSError: the file cannot be read
    """
    suffix = path.suffix.lower()
    if suffix not in (".obj", ".stl"):
        raise ValueError(f"its format must be OBJ or STL, got {path.suffix!r}")
    parts = [(path.stem, stl_corners(path))] if suffix == ".stl" else _obj_parts(path)
    if not sum(len(points) for _, points in parts):
        raise ValueError("it has no faces")
    if not all(np.isfinite(points).all() for _, points in parts):
        raise ValueError("a vertex is not finite")
    return parts


def ascii_stl_as_obj(path: Path) -> str | None:
    """Return an ASCII STL file, which Bullet does not read, as the text of an OBJ file, None for others."""
    if path.suffix.lower() != ".stl" or _is_binary(path.read_bytes()):
        return None
    corners = stl_corners(path)
    return wavefront([Piece(Convex(Mesh.of(corners, np.arange(len(corners)).reshape(-1, 3))))])


def _is_binary(data: bytes) -> bool:
    count = int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")
    return len(data) >= STL_HEADER and len(data) == STL_HEADER + STL_FACET * count


def stl_corners(path: Path) -> FloatArray:
    """Return the corners (3 n, 3) of the facets of a binary or ASCII STL file, or raise ValueError."""
    data = path.read_bytes()
    if _is_binary(data):
        facets = np.frombuffer(data[STL_HEADER:], np.uint8).reshape(-1, STL_FACET)[:, 12:48]
        return np.ascontiguousarray(facets).view("<f4").reshape(-1, 3).astype(np.float64)
    if not data.lstrip().lower().startswith(b"solid"):
        raise ValueError("its length does not agree with its number of facets")
    points = np.array([[float(number) for number in match] for match in VERTEX.findall(data)])
    if len(points) % 3 or len(points) != 3 * len(re.findall(rb"\bendfacet\b", data, re.IGNORECASE)):
        raise ValueError("its facets are not triangles")
    return points.reshape(-1, 3)


def _obj_parts(path: Path) -> list[tuple[str, FloatArray]]:
    """Return the parts of an OBJ file that have faces."""
    vertices: list[list[float]] = []
    parts: list[tuple[str, list[int]]] = [(path.stem, [])]
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    # A backslash at the end of a line continues it.
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        kind, *words = line.split() or [""]
        try:
            if kind in ("o", "g"):
                parts.append((" ".join(words), []))
            elif kind == "v":
                x, y, z = (float(word) for word in words[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                first, *others = (_vertex(word, len(vertices)) for word in words)
                parts[-1][1].extend(corner for pair in pairwise(others) for corner in (first, *pair))
        except ValueError as error:
            raise ValueError(f"{error}, in the line {line!r}") from error
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return [(name, points[indices]) for name, indices in parts if indices]


def _vertex(word: str, count: int) -> int:
    """Return the index of a face's corner. The file counts from 1, or backwards from the last vertex."""
    number = int(word.partition("/")[0])
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count:
        raise ValueError(f"a face names vertex {number} of {count}")
    return index


def _check_collada(path: Path) -> None:
    elements = [(element.tag.rpartition("}")[2], element) for element in ElementTree.parse(path).iter()]
    counts = [int(element.get("count", "0")) for tag, element in elements if tag in ("triangles", "polylist")]
    if elements[0][0] != "COLLADA" or not any(counts):
        raise ValueError("it has no <triangles> and no <polylist>")
    arrays = [element.text or "" for tag, element in elements if tag == "float_array"]
    if not np.isfinite([float(word) for text in arrays for word in text.split()]).all():
        raise ValueError("a vertex is not finite")
