"""The objects of a folder, and a warning that names the files in it that are not used."""

import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from bulletarm_gym.objects.files import FRICTIONS, is_urdf, load_object
from bulletarm_gym.simulation.shapes import BodySpec
from bulletarm_gym.simulation.urdf import mesh_path, parse_urdf

MESHES = (".obj", ".stl")
"""File name extensions, in capitals or small letters, of the meshes that are read."""
OTHER_MODELS = (
    *(".dae", ".ply", ".off", ".glb", ".gltf", ".3ds", ".3mf", ".fbx", ".wrl", ".vtk", ".msh"),
    *(".step", ".stp", ".sdf", ".xacro", ".xml", ".usd", ".usda", ".usdc"),
)
"""File name extensions of models in formats that are not read."""
SOLVER_ELEMENTS = ("contact_cfm", "contact_erp", "inertia_scaling")
"""Elements of a URDF's ``<contact>`` that set no property of the material."""


def load_folder(folder: str) -> tuple[BodySpec, ...]:
    """Return the objects of all files in a folder and the folders within it, sorted by path.

    If a folder has URDF files, the meshes in it and in the folders within it are parts of them. Symbolic
    links are followed. One warning names files that cannot be loaded, with the reasons, other models that are
    not used, and contact properties that are not used.

    :raises ValueError: there is no such file, or none can be loaded; the message names files and reasons
    """
    paths = sorted(_object_files(Path(folder)))
    if not paths:
        raise ValueError(f"object_set: {folder!r} holds no .obj, no .stl and no .urdf file")
    specs, used, faults = [], set(), []
    for path in paths:
        try:
            specs.append(load_object(path, str(path.relative_to(folder))))
            used |= {path, *_meshes_of(path)}
        except ValueError as error:
            faults.append(str(error))
            used.add(path)
    if not specs:
        raise ValueError("; ".join(faults))
    lost = [f"{len(faults)} of {len(paths)} files are left out: {'; '.join(faults)}"] if faults else []
    lost += [*_unused_files(Path(folder), used), *_unused_properties(used)]
    if lost:
        warnings.warn("; ".join(lost), stacklevel=2)
    return tuple(specs)


def _object_files(folder: Path) -> Iterator[Path]:
    described: set[Path] = set()  # folders with URDF files, and the folders within them
    for parent, names in _walk(folder):
        if parent.parent in described or any(name.lower().endswith(".urdf") for name in names):
            described.add(parent)
        endings = (".urdf",) if parent in described else (".urdf", *MESHES)
        yield from (parent / name for name in names if name.lower().endswith(endings))


def _walk(folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield each folder with the names of its files; one that links lead back to comes once."""
    known: set[str] = set()
    for parent, folders, files in os.walk(folder, followlinks=True):
        known.add(os.path.realpath(parent))
        folders[:] = [name for name in sorted(folders) if os.path.realpath(Path(parent, name)) not in known]
        yield Path(parent), files


def _meshes_of(path: Path) -> list[Path]:
    """Return the meshes that a URDF names and that exist."""
    found = []
    for mesh in parse_urdf(path).iter("mesh") if is_urdf(path) else ():
        try:
            found.append(mesh_path(mesh.get("filename", ""), path.parent.absolute()))
        except ValueError:  # of a visual, which is not used
            continue
    return found


def _unused_files(folder: Path, used: set[Path]) -> list[str]:
    """Return a sentence on the models in a folder that are not used, if there are any."""
    real = {os.path.realpath(path) for path in used}
    files = [parent / name for parent, names in _walk(folder) for name in names]
    models = [path for path in files if path.suffix.lower() in (*MESHES, *OTHER_MODELS)]
    names = sorted(str(path.relative_to(folder)) for path in models if os.path.realpath(path) not in real)
    reason = (
        "OBJ, STL and URDF files are read; in a folder with URDF files and the folders within it, only the "
        "meshes that they name"
    )
    return [f"object_set: {len(names)} files are not used: {', '.join(names)} ({reason})"] if names else []


def _unused_properties(paths: set[Path]) -> Sequence[str]:
    """Return a sentence on the contact properties in URDF files that are not used, if there are any."""
    known = (*FRICTIONS, *SOLVER_ELEMENTS)
    tags: set[str] = set()
    for path in filter(is_urdf, paths):
        try:
            elements = parse_urdf(path).iterfind("link/contact/*")
            tags |= {element.tag for element in elements if element.tag not in known}
        except (ValueError, OSError):  # named already
            continue
    return [f"object_set: contact properties are not used: {', '.join(sorted(tags))}"] if tags else []
