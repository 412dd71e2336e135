"""Robot models that come with PyBullet."""

from pathlib import Path
from xml.etree import ElementTree


def load_model(relative: str) -> ElementTree.Element:
    """Read a URDF of ``pybullet_data`` with its mesh paths made absolute."""
    import pybullet_data

    path = Path(pybullet_data.getDataPath()) / relative
    root = ElementTree.parse(path).getroot()
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(path.parent / mesh.get("filename", "")))
    return root
