"""Robot models in files: those that come with PyBullet, and users' own."""

from os import PathLike
from pathlib import Path
from xml.etree import ElementTree

from bulletarm_gym.simulation.meshes import check_mesh
from bulletarm_gym.simulation.xml import parse_urdf

PACKAGE, FILE = "package://", "file://"
"""How ROS names the files of a package, and any file."""


def load_model(relative: str) -> ElementTree.Element:
    """Read a URDF of ``pybullet_data``, see :func:`read_urdf`; its meshes are not checked."""
    import pybullet_data

    return _read(Path(pybullet_data.getDataPath()) / relative)


def read_urdf(path: str | PathLike[str]) -> ElementTree.Element:
    """Read a URDF with the paths of its meshes made absolute, so that it can be written elsewhere.

    :param path: of the file; its meshes lie where :func:`mesh_path` looks for them
    :raises ValueError: it is not a URDF, or a mesh is not found or cannot be read
    :raises OSError: it cannot be read
    """
    root = _read(Path(path))
    for mesh in root.iter("mesh"):
        check_mesh(Path(mesh.get("filename", "")))
    return root


def _read(path: Path) -> ElementTree.Element:
    file = path.absolute()
    root = parse_urdf(file)
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(mesh_path(mesh.get("filename", ""), file.parent)))
    return root


def mesh_path(name: str, folder: Path) -> Path:
    """Return the absolute path of a mesh.

    :param name: in a URDF; ``package://`` paths are looked for in the folder of the file and in those above
        it, one of which holds the package, or is it, as in PyBullet
    :param folder: absolute, of the file
    :raises ValueError: it is not there
    """
    folders = [folder, *folder.parents] if name.startswith(PACKAGE) else [folder]
    for place in folders:
        found = place / name.removeprefix(PACKAGE).removeprefix(FILE)
        if found.is_file():
            return found
    where = "there or in the folders above" if len(folders) > 1 else "there"
    raise ValueError(f"the mesh {name!r} of a model in {folder} is not {where}")
