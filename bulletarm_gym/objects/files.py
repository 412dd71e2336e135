"""Objects from a user's OBJ or URDF files.

As in Bullet, each named part of an OBJ file becomes one convex hull. A URDF gives the collision geometry and
colour of one rigid link; its placeholder inertia is not used, a body has that of its shape.
"""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose, multiply, yaw_quaternion
from bulletarm_gym.objects.graspables import graspable
from bulletarm_gym.objects.hull import convex_hull
from bulletarm_gym.simulation.assets import mesh_path
from bulletarm_gym.simulation.shapes import BodySpec, Box, Colour, Convex, Piece

SMALLEST = 0.005
LARGEST = 0.3
"""Sides (m) of a bounding box between which an object can be handled at all: a wrong unit is noticed."""
GREY: Colour = (0.7, 0.7, 0.7, 1.0)


def load_folder(folder: str) -> tuple[BodySpec, ...]:
    """Return the objects of all files in a folder and the folders within it, sorted by path.

    Where a folder has URDF files, OBJ files in it are taken to be their parts. Symbolic links are followed.
    Files that cannot be loaded are left out, with one warning that names them and the reasons.

    :raises ValueError: there is no such file, or none can be loaded; the message names files and reasons
    """
    paths = sorted(_object_files(Path(folder)))
    if not paths:
        raise ValueError(f"object_set: {folder!r} holds no .obj and no .urdf file")
    specs, faults = [], []
    for path in paths:
        try:
            specs.append(load_object(path, str(path.relative_to(folder))))
        except ValueError as error:
            faults.append(str(error))
    if not specs:
        raise ValueError("; ".join(faults))
    if faults:
        warnings.warn(f"{len(faults)} of {len(paths)} files are left out: {'; '.join(faults)}", stacklevel=2)
    return tuple(specs)


def _object_files(folder: Path) -> Iterator[Path]:
    for parent, names in _walk(folder):
        described = [name for name in names if name.endswith(".urdf")]
        yield from (parent / name for name in described or names if name.endswith((".urdf", ".obj")))


def _walk(folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield each folder with the names of its files; one that links lead back to comes once."""
    known: set[str] = set()
    for parent, folders, files in os.walk(folder, followlinks=True):
        known.add(os.path.realpath(parent))
        folders[:] = [name for name in sorted(folders) if os.path.realpath(Path(parent, name)) not in known]
        yield Path(parent), files


def load_object(path: Path, name: str) -> BodySpec:
    """Return the object of a file, with the mass and friction of all objects to be grasped.

    :raises ValueError: it cannot be loaded
    """
    try:
        pieces, colour = (
            _from_urdf(path) if path.suffix == ".urdf" else (_from_obj(path, (1.0, 1.0, 1.0)), GREY)
        )
        spec = graspable(name, pieces, colour)
        if not (SMALLEST <= min(spec.extents) and max(spec.extents) <= LARGEST):
            sides = " x ".join(f"{side:.4g}" for side in spec.extents)
            raise ValueError(f"it is {sides} m, its sides may be {SMALLEST} to {LARGEST} m")
    except (ValueError, OSError, ElementTree.ParseError) as error:
        raise ValueError(f"object_set: {path} cannot be loaded: {error}") from error
    return spec


def _from_obj(path: Path, scale: tuple[float, ...]) -> list[Piece]:
    """Return the convex hull of every named part of an OBJ file."""
    vertices: list[list[float]] = []
    parts: list[list[int]] = [[]]
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *words = line.split() or [""]
        if kind in ("o", "g"):
            parts.append([])
        elif kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "f":
            parts[-1] += [_vertex(word, len(vertices)) for word in words]
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3) * np.array(scale)
    used = [part for part in parts if part]
    if not used:
        raise ValueError("it has no faces")
    return [Piece(Convex(convex_hull(points[part]))) for part in used]


def _vertex(word: str, count: int) -> int:
    """Return the index of a face's corner, which counts from 1, or backwards from the last vertex."""
    number = int(word.partition("/")[0])
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count:
        raise ValueError(f"a face names vertex {number} of {count}")
    return index


def _from_urdf(path: Path) -> tuple[list[Piece], Colour]:
    """Return the pieces of a URDF's one link and its colour."""
    root = ElementTree.parse(path).getroot()
    links = root.findall("link")
    if len(links) != 1:
        raise ValueError(f"it has {len(links)} links; an object to grasp is one rigid link")
    collisions = links[0].findall("collision")
    if not collisions:
        raise ValueError("its link has no collision geometry")
    pieces = [piece for collision in collisions for piece in _collision_pieces(collision, path.parent)]
    return pieces, _colour(root)


def _collision_pieces(collision: ElementTree.Element, folder: Path) -> list[Piece]:
    pose = _origin(collision.find("origin"))
    mesh, box = collision.find("geometry/mesh"), collision.find("geometry/box")
    if box is not None:
        x, y, z = _floats(box.get("size", ""))
        return [Piece(Box((x, y, z)), pose)]
    if mesh is None:
        raise ValueError("its collision geometry is neither a mesh nor a box")
    file = mesh_path(mesh.get("filename", ""), folder.absolute())
    if file.suffix.lower() != ".obj":
        raise ValueError(f"its mesh {file.name!r} is not an OBJ file")
    return [Piece(piece.shape, pose) for piece in _from_obj(file, tuple(_floats(mesh.get("scale", "1 1 1"))))]


def _origin(origin: ElementTree.Element | None) -> Pose:
    """Return the frame that a URDF origin describes."""
    if origin is None:
        return Pose((0.0, 0.0, 0.0))
    x, y, z = _floats(origin.get("xyz", "0 0 0"))
    roll, pitch, yaw = (angle / 2.0 for angle in _floats(origin.get("rpy", "0 0 0")))
    about_x = (float(np.sin(roll)), 0.0, 0.0, float(np.cos(roll)))
    about_y = (0.0, float(np.sin(pitch)), 0.0, float(np.cos(pitch)))
    return Pose((x, y, z), multiply(yaw_quaternion(2.0 * yaw), multiply(about_y, about_x)))


def _floats(text: str) -> FloatArray:
    values = np.array([float(word) for word in text.split()])
    if len(values) != 3:
        raise ValueError(f"{text!r} is not three numbers")
    return values


def _colour(root: ElementTree.Element) -> Colour:
    element = root.find(".//material/color")
    if element is None:
        return GREY
    red, green, blue, alpha = (float(word) for word in element.get("rgba", "").split())
    return (red, green, blue, alpha)
