"""Bodies with sliding parts as URDF, the only form in which Bullet takes joints with limits."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from bulletarm_gym.geometry import Pose, Vector, matrix
from bulletarm_gym.simulation.shapes import BodySpec, Box, Colour, Piece, Slide, wavefront

BASE = "base"


def write_urdf(spec: BodySpec, folder: Path) -> Path:
    """Write a body and its slides as ``body.urdf`` in a folder.

    :return: the path of the file
    """
    root = ElementTree.Element("robot", name=spec.name)
    root.append(_link(BASE, spec.pieces, 0.0, spec.colour, folder))
    for slide in spec.slides:
        root.append(_link(slide.name, slide.pieces, slide.mass, slide.colour, folder))
        root.append(_joint(slide))
    path = folder / "body.urdf"
    ElementTree.ElementTree(root).write(path)
    return path


def _link(
    name: str, pieces: Sequence[Piece], mass: float, colour: Colour, folder: Path
) -> ElementTree.Element:
    link = ElementTree.Element("link", name=name)
    frame, moments = BodySpec(name, tuple(pieces), mass).mass_properties
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_text(frame.position))
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    ElementTree.SubElement(inertial, "inertia", _tensor(frame, moments))
    for number, piece in enumerate(pieces):
        path = folder / f"{name}_{number}.obj"
        path.write_text(wavefront([piece]))
        for kind in ("visual", "collision"):
            element = ElementTree.SubElement(link, kind)
            if isinstance(piece.shape, Box) and kind == "collision":
                _add_box(element, piece, piece.shape)
            else:
                geometry = ElementTree.SubElement(element, "geometry")
                ElementTree.SubElement(geometry, "mesh", filename=str(path))
            if kind == "visual":
                material = ElementTree.SubElement(element, "material", name=f"{name} colour")
                ElementTree.SubElement(material, "color", rgba=_text(colour))
    return link


def _add_box(element: ElementTree.Element, piece: Piece, shape: Box) -> None:
    """Boxes collide as boxes; only their yaw is written, which is all that furniture needs."""
    ElementTree.SubElement(
        element, "origin", xyz=_text(piece.pose.position), rpy=_text((0.0, 0.0, piece.pose.yaw))
    )
    geometry = ElementTree.SubElement(element, "geometry")
    ElementTree.SubElement(geometry, "box", size=_text(shape.extents))


def _joint(slide: Slide) -> ElementTree.Element:
    joint = ElementTree.Element("joint", name=slide.name, type="prismatic")
    ElementTree.SubElement(joint, "parent", link=BASE)
    ElementTree.SubElement(joint, "child", link=slide.name)
    ElementTree.SubElement(joint, "axis", xyz=_text(slide.axis))
    low, high = slide.limits
    limits = {"lower": repr(low), "upper": repr(high), "effort": "100", "velocity": "10"}
    ElementTree.SubElement(joint, "limit", limits)
    return joint


def _tensor(frame: Pose, moments: Vector) -> dict[str, str]:
    """Inertia about the centre of mass in the axes of the link."""
    rotation = matrix(frame)
    full = rotation @ (rotation * moments).T
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    return {name: repr(float(full[index])) for name, index in names.items()}


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(value) for value in values)
