"""Bodies with parts that slide or turn as URDF, the only form in which Bullet takes joints with limits."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from bulletarm_gym.geometry import Pose, Vector, euler_angles, matrix
from bulletarm_gym.simulation.shapes import BodySpec, Box, Colour, Hinge, Piece, Slide, wavefront

BASE = "base"


def write_urdf(spec: BodySpec, folder: Path) -> Path:
    """Write a body and its parts as ``body.urdf`` in a folder.

    :return: the path of the file
    """
    root = ElementTree.Element("robot", name=spec.name)
    root.append(_link(BASE, spec.pieces, spec.mass, spec.colour, folder, spec.mass > 0.0))
    for part in spec.parts:
        root.append(_link(part.name, _in_link(part), part.mass, part.colour, folder, spec.mass > 0.0))
        root.append(_joint(part))
    path = folder / "body.urdf"
    ElementTree.indent(root)  # Bullet breaks lines of more than 1,023 characters, wherever that is
    ElementTree.ElementTree(root).write(path)
    return path


def _link(
    name: str, pieces: Sequence[Piece], mass: float, colour: Colour, folder: Path, free: bool
) -> ElementTree.Element:
    link = ElementTree.Element("link", name=name)
    link.append(_inertial(*BodySpec(name, tuple(pieces), mass).mass_properties, mass, free))
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


def _inertial(frame: Pose, moments: Vector, mass: float, free: bool) -> ElementTree.Element:
    """Return a link's mass and inertia: of a free body in its principal axes, in which its pose is read."""
    inertial = ElementTree.Element("inertial")
    turn = {"rpy": _text(euler_angles(frame.orientation))} if free else {}
    ElementTree.SubElement(inertial, "origin", {"xyz": _text(frame.position), **turn})
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    axes = Pose((0.0, 0.0, 0.0)) if free else frame
    ElementTree.SubElement(inertial, "inertia", _tensor(axes, moments))
    return inertial


def _in_link(part: Slide | Hinge) -> Sequence[Piece]:
    """Return a part's pieces in the frame of its link: a hinge's has its origin on the axis."""
    if isinstance(part, Slide):
        return part.pieces
    back = Pose(part.pivot).inverse()
    return [Piece(piece.shape, back.compose(piece.pose)) for piece in part.pieces]


def _add_box(element: ElementTree.Element, piece: Piece, shape: Box) -> None:
    """Boxes collide as boxes."""
    ElementTree.SubElement(
        element,
        "origin",
        xyz=_text(piece.pose.position),
        rpy=_text(euler_angles(piece.pose.orientation)),
    )
    geometry = ElementTree.SubElement(element, "geometry")
    ElementTree.SubElement(geometry, "box", size=_text(shape.extents))


def _joint(part: Slide | Hinge) -> ElementTree.Element:
    kind = "revolute" if isinstance(part, Hinge) else "prismatic"
    joint = ElementTree.Element("joint", name=part.name, type=kind)
    ElementTree.SubElement(joint, "parent", link=BASE)
    ElementTree.SubElement(joint, "child", link=part.name)
    if isinstance(part, Hinge):
        ElementTree.SubElement(joint, "origin", xyz=_text(part.pivot))
    ElementTree.SubElement(joint, "axis", xyz=_text(part.axis))
    low, high = part.limits
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
