"""Objects from users' OBJ, STL and URDF files.

As in Bullet, each named part of an OBJ file becomes one convex hull. A URDF defines the collision geometry,
colour, mass and friction of one rigid link. Its inertia is not used: it follows from the shape.
"""

import os
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from bulletarm_gym.config_checks import check_argument, numbers
from bulletarm_gym.geometry import FloatArray, Mesh, Pose, Vector
from bulletarm_gym.objects.graspables import graspable
from bulletarm_gym.objects.solids import corner_radius, cylinder, laid_flat
from bulletarm_gym.simulation.shapes import ORIGIN, BodySpec, Box, Colour, Convex, Piece, mesh_parts
from bulletarm_gym.simulation.urdf import frame_of, mesh_path, number_of, numbers_of, parse_urdf, vector_of

SIDES = (0.005, 0.3)
"""Range of the sides (m) of a bounding box, which detects a wrong unit."""
MASSES = (1e-3, 5.0)
"""Range of the mass (kg) of an object, which detects a wrong unit."""
CONCAVITY = 0.02
"""Depth of a face in the convex hull, relative to its longest side, above which a part is concave."""
CYLINDER_SIDES = 16
"""Corners of the polygon that approximates the circle of a cylinder."""
GREY: Colour = (0.7, 0.7, 0.7, 1.0)
"""Colour of an object whose file defines none."""
MESHES = (".obj", ".stl")
"""File name extensions, in lower case, of the meshes that are read."""
OTHER_MODELS = (
    *(".dae", ".ply", ".off", ".glb", ".gltf", ".3ds", ".3mf", ".fbx", ".wrl", ".vtk", ".msh"),
    *(".step", ".stp", ".sdf", ".xacro", ".xml", ".usd", ".usda", ".usdc"),
)
"""File name extensions, in lower case, of models in formats that are not read."""
PARAMETERS = {
    "mass": "mass",
    "lateral_friction": "friction",
    "rolling_friction": "rolling_friction",
    "spinning_friction": "spinning_friction",
}
"""Elements of a URDF's link and the parameters of :class:`BodySpec` that they set."""
SOLVER_ELEMENTS = {"contact_cfm", "contact_erp", "inertia_scaling"}
"""Elements of a URDF's ``<contact>`` that configure the solver of the contacts, without a warning."""
NO_EFFECT = "elements that have no effect"

Notes: TypeAlias = defaultdict[str, set[str]]
"""Parts of a warning: what happened, and the names that it happened to."""


def load_folder(folder: str) -> tuple[BodySpec, ...]:
    """Return the objects of all files in a folder and its subfolders, laid flat and sorted by path.

    If a folder has URDF files, the meshes in it and in its subfolders are parts of them. Symbolic links are
    followed. One warning names the files that cannot be loaded, with the reasons, the models and elements
    that have no effect, and the concave meshes.

    :raises ValueError: the folder has no such file, or none can be loaded; the message names the reasons
    """
    root = Path(folder)
    files = list(_walk(root))
    paths = sorted(_object_files(files))
    if not paths:
        raise ValueError(f"object_set: {folder!r} holds no .obj, no .stl and no .urdf file")
    specs, faults, notes = [], [], Notes(set)
    for path in paths:
        try:
            spec = _read(path, str(path.relative_to(root)), notes)
            specs.append(replace(spec, pieces=laid_flat(spec.pieces)))
        except ValueError as error:
            faults.append(str(error))
    if not specs:
        raise ValueError(f"object_set: {'; '.join(faults)}")
    if faults:
        notes[f"{len(faults)} of {len(paths)} files are left out"].update(faults)
    if unused := _unused_models(files, paths):
        names = {str(path.relative_to(root)) for path in unused}
        notes["files that are not used (OBJ and STL files, and the meshes that a URDF names, are)"] = names
    if any(b"map_Kd" in path.read_bytes() for path in files if path.suffix.lower() == ".mtl"):
        notes[NO_EFFECT].add("map_Kd")
    _warn("object_set", notes)
    return tuple(specs)


def _warn(subject: str, notes: Notes) -> None:
    """Emit one warning with all notes, if there are any."""
    if notes:
        parts = [f"{what}: {', '.join(sorted(names))}" for what, names in notes.items()]
        warnings.warn(f"{subject}: {'; '.join(parts)}", stacklevel=3)


def _walk(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders; folders that links lead back to come once."""
    known: set[str] = set()
    for parent, folders, names in os.walk(folder, followlinks=True):
        known.add(os.path.realpath(parent))
        folders[:] = [name for name in sorted(folders) if os.path.realpath(Path(parent, name)) not in known]
        yield from (path for name in names if (path := Path(parent, name)).is_file())


def _object_files(files: Iterable[Path]) -> Iterator[Path]:
    """Yield URDF files, and the meshes that are not in a folder with URDF files or below it."""
    described = {path.parent for path in files if path.suffix.lower() == ".urdf"}
    for path in files:
        is_part = path.suffix.lower() in MESHES and described.intersection(path.parents)
        if path.suffix.lower() in (".urdf", *MESHES) and not is_part:
            yield path


def _unused_models(files: Iterable[Path], loaded: Iterable[Path]) -> set[Path]:
    """Return the models that are neither loaded nor named by a URDF."""
    urdfs = [path for path in loaded if path.suffix.lower() == ".urdf"]
    text = "\n".join(path.read_text(errors="replace") for path in urdfs)
    models = {path for path in files if path.suffix.lower() in (*MESHES, *OTHER_MODELS)}
    return {path for path in models.difference(loaded) if path.name not in text}


def load_object(path: str | os.PathLike[str], name: str, scale: float = 1.0) -> BodySpec:
    """Return the object of an OBJ, STL or URDF file in the file's frame, for a task of your own.

    Omitted properties are those of the built-in objects to grasp. A warning names the elements without effect
    and the concave meshes.

    :param name: unique in the scene
    :param scale: factor on the size, such as 0.001 for a mesh in millimetres; the mass does not change
    :raises ValueError: ``scale`` is not positive, or the file cannot be loaded, with the reason
    """
    notes = Notes(set)
    scale = check_argument("scale", scale, numbers("positive"))
    spec = _read(Path(path), name, notes, scale)
    _warn(str(path), notes)
    return spec


def _read(path: Path, name: str, notes: Notes, scale: float = 1.0) -> BodySpec:
    """Return the object of a file in the file's frame; add to the notes of the warning."""
    try:
        if path.suffix.lower() == ".urdf":
            spec = _from_urdf(path, name, notes)
        else:
            spec = graspable(name, _hulls(path, notes), GREY)
        spec = replace(spec, pieces=tuple(piece.scaled(scale) for piece in spec.pieces))
        if not (SIDES[0] <= min(spec.extents) and max(spec.extents) <= SIDES[1]):
            sides = " x ".join(f"{side:.4g}" for side in spec.extents)
            raise ValueError(f"its sides must be {SIDES[0]} to {SIDES[1]} m, got {sides}")
        if not MASSES[0] <= spec.mass <= MASSES[1]:
            raise ValueError(f"its mass must be {MASSES[0]} to {MASSES[1]} kg, got {spec.mass:g}")
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} cannot be loaded: {error}") from error
    return spec


def convex_hull(points: ArrayLike) -> Mesh:
    """Return the convex hull of points (m) as a closed mesh whose faces look outward.

    :param points: (n, 3), in any order
    :raises ValueError: a point is not finite, or the points enclose no volume
    """
    cloud = np.unique(np.asarray(points, dtype=np.float64).reshape(-1, 3), axis=0)
    if not np.isfinite(cloud).all():
        raise ValueError("a vertex is not finite")
    if len(cloud) < 4:
        raise ValueError(f"{len(cloud)} different vertices enclose no volume")
    middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2.0
    unit = (cloud - middle) / np.ptp(cloud, axis=0).max()  # Qhull's tolerances grow with the coordinates
    try:
        hull = ConvexHull(unit)
    except QhullError as error:
        raise ValueError("the vertices lie in a plane and enclose no volume") from error
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    corners = unit[used][faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_inward = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0.0
    faces = np.where(is_inward[:, None], faces[:, ::-1], faces)
    return Mesh.of(cloud[used], faces[np.linalg.norm(normals, axis=1) > 0.0])


def _is_concave(corners: FloatArray, hull: Mesh) -> bool:
    """Return True if the centre of a triangle is clearly inside the convex hull of all corners."""
    centres = corners.reshape(-1, 3, 3).mean(axis=1)
    depths = np.full(len(centres), np.inf)
    for a, b, c in hull.vertices[hull.faces]:
        normal = np.cross(b - a, c - a)
        depths = np.minimum(depths, (a - centres) @ (normal / np.linalg.norm(normal)))
    return bool(depths.max() > CONCAVITY * np.ptp(hull.vertices, axis=0).max())


def _hulls(path: Path, notes: Notes, scale: Vector = (1.0, 1.0, 1.0), pose: Pose = ORIGIN) -> list[Piece]:
    """Return the convex hull of every part of a mesh."""
    pieces = []
    for name, corners in mesh_parts(path):
        try:
            hull = convex_hull(corners * np.array(scale))
        except ValueError as error:
            raise ValueError(f"{error} (part {name!r})") from error
        if _is_concave(corners * np.array(scale), hull):
            notes["concave parts, replaced by their convex hulls"].add(f"{path} (part {name!r})")
        pieces.append(Piece(Convex(hull), pose))
    return pieces


def _from_urdf(path: Path, name: str, notes: Notes) -> BodySpec:
    """Return the object of a URDF's one link."""
    root, folder = parse_urdf(path), path.parent.absolute()
    links = root.findall("link")
    if len(links) != 1:
        raise ValueError(f"it must have one rigid link, got {len(links)} links")
    collisions = links[0].findall("collision")
    if not collisions:
        raise ValueError("its link has no collision geometry")
    pieces = [piece for collision in collisions for piece in _collision_pieces(collision, folder, notes)]
    values: dict[str, Any] = {}
    unused = {element.tag for element in root.iter("texture")}
    for element in (*links[0].iterfind("inertial/mass"), *links[0].iterfind("contact/*")):
        if element.tag in PARAMETERS:
            values[PARAMETERS[element.tag]] = number_of(element, "value", "")
        elif element.tag not in SOLVER_ELEMENTS:
            unused.add(element.tag)
    if unused:
        notes[NO_EFFECT] |= unused
    return replace(graspable(name, pieces, _colour(root)), **values)


def _collision_pieces(collision: Element, folder: Path, notes: Notes) -> list[Piece]:
    pose, shape = frame_of(collision), collision.find("geometry/*")
    tag = None if shape is None else shape.tag
    if shape is not None and tag == "box":
        return [Piece(Box(vector_of(shape, "size", "")), pose)]
    if shape is not None and tag == "cylinder":
        sides = {name: number_of(shape, name, "") for name in ("radius", "length")}
        radius, length = (check_argument(name, side, numbers("positive")) for name, side in sides.items())
        return [cylinder(corner_radius(2.0 * radius, CYLINDER_SIDES), length, CYLINDER_SIDES, pose)]
    if shape is None or tag != "mesh":
        raise ValueError(f"its collision geometry must be a mesh, a box or a cylinder, got {tag}")
    return _hulls(
        mesh_path(shape.get("filename", ""), folder), notes, vector_of(shape, "scale", "1 1 1"), pose
    )


def _colour(root: Element) -> Colour:
    """Return the colour of a URDF's first visual, its own or that of the material that it names."""
    material = root.find("link/visual/material")
    if material is None:
        return GREY
    named = [other for other in root.findall("material") if other.get("name") == material.get("name")]
    colours = [colour for one in (material, *named) if (colour := one.find("color")) is not None]
    if not colours:
        return GREY
    red, green, blue, alpha = numbers_of(colours[0], "rgba", 4)
    return (red, green, blue, alpha)
