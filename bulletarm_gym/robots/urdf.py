"""Writing URDF: links of primitives, and links on fixed joints made part of those that carry them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element, SubElement

from bulletarm_gym.geometry import Pose, Vector, euler_angles, euler_pose, from_rotvec
from bulletarm_gym.robots.kinematics import axis_of, frame_of, number_of

ORIGIN = Pose((0.0, 0.0, 0.0))

Colour = tuple[float, float, float]

DARK: Colour = (0.25, 0.25, 0.27)
LIGHT: Colour = (0.55, 0.57, 0.60)


@dataclass(frozen=True)
class Part:
    """A primitive of a link.

    :param kind: ``"box"``, ``"cylinder"`` (along its z axis) or ``"sphere"``
    :param extents: full side lengths (m) of its bounding box
    :param pose: of its centre in the link
    :param solid: whether it collides, or is only seen
    """

    kind: str
    extents: Vector
    pose: Pose
    colour: Colour
    solid: bool = True

    def seen_from(self, frame: Pose) -> "Part":
        """Return the part in the link that holds ``frame``."""
        return replace(self, pose=frame.compose(self.pose))

    def elements(self) -> list[Element]:
        """Return the URDF elements."""
        visual = self.element("visual")
        material = SubElement(visual, "material", name="colour " + _text(self.colour))
        SubElement(material, "color", rgba=_text((*self.colour, 1.0)))
        return [visual, self.element("collision")] if self.solid else [visual]

    def element(self, tag: str) -> Element:
        """Return the bare ``"visual"`` or ``"collision"`` element."""
        element = Element(tag)
        SubElement(element, "origin", _origin(self.pose))
        geometry = SubElement(element, "geometry")
        x, _, z = self.extents
        sizes = {
            "box": {"size": _text(self.extents)},
            "cylinder": {"radius": repr(x / 2.0), "length": repr(z)},
            "sphere": {"radius": repr(x / 2.0)},
        }
        SubElement(geometry, self.kind, sizes[self.kind])
        return element


def box(extents: Vector, centre: Vector, colour: Colour, tilt: float = 0.0, solid: bool = True) -> Part:
    """Return a box (m), turned by ``tilt`` (rad) about its y axis."""
    return Part("box", extents, euler_pose(centre, (0.0, tilt, 0.0)), colour, solid)


def cylinder(
    radius: float, length: float, centre: Vector, colour: Colour, axis: str = "z", solid: bool = True
) -> Part:
    """Return a cylinder (m) along an axis of its link, ``"x"``, ``"y"`` or ``"z"``."""
    angles = {"x": (0.0, math.pi / 2.0, 0.0), "y": (math.pi / 2.0, 0.0, 0.0), "z": (0.0, 0.0, 0.0)}
    diameter = 2.0 * radius
    return Part("cylinder", (diameter, diameter, length), euler_pose(centre, angles[axis]), colour, solid)


def add_link(root: Element, name: str, mass: float, parts: Sequence[Part]) -> None:
    """Add a link of parts.

    Its mass (kg) lies in the middle of the first part; Bullet computes the inertia from what collides, the
    numbers here, of a box, are for other readers.
    """
    link = SubElement(root, "link", name=name)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", _origin(parts[0].pose))
    SubElement(inertial, "mass", value=repr(mass))
    SubElement(inertial, "inertia", _inertia(mass, parts[0].extents))
    add_parts(link, parts)


def add_parts(link: Element, parts: Sequence[Part]) -> None:
    """Add parts to a link."""
    for part in parts:
        link.extend(part.elements())


def add_joint(
    root: Element, kind: str, name: str, links: tuple[str, str], origin: Pose, axis: Vector
) -> Element:
    """Add a joint between a parent and a child link and return it."""
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=links[0])
    SubElement(joint, "child", link=links[1])
    SubElement(joint, "origin", _origin(origin))
    SubElement(joint, "axis", xyz=_text(axis))
    return joint


def find_link(root: Element, name: str) -> Element:
    """Return a link.

    :raises ValueError: the model has none of that name
    """
    for link in root.findall("link"):  # not by XPath, in which a name cannot have quotes
        if link.get("name") == name:
            return link
    raise ValueError(f"the model has no link {name!r}")


def merge_fixed(root: Element) -> None:
    """Make links on fixed joints part of their parents: each costs as much to simulate as one that moves."""
    for joint in root.findall("joint[@type='fixed']"):
        parent, child = (find_link(root, end_of(joint, end)) for end in ("parent", "child"))
        mount = frame_of(joint)
        _add_mass(parent, child, mount)
        for element in [*child.findall("visual"), *child.findall("collision")]:
            _move(element, mount)
            parent.append(element)
        for other in root.findall("joint"):
            if end_of(other, "parent") == child.get("name"):
                _move(other, mount)
                other.findall("parent")[0].set("link", end_of(joint, "parent"))
        root.remove(joint)
        root.remove(child)


def end_of(joint: Element, end: str) -> str:
    """Return the name of a joint's ``"parent"`` or ``"child"``.

    :raises ValueError: the joint has none
    """
    element = joint.find(end)
    if element is None:
        raise ValueError(f"joint {joint.get('name')!r} must have a <{end}>")
    return element.get("link", "")


def _move(element: Element, frame: Pose) -> None:
    """Express in an outer frame an element given in ``frame``."""
    put_origin(element, frame.compose(frame_of(element)))


def pose_at(joint: Element, position: float) -> Pose:
    """Return the pose of a joint's child link in its parent link at a position (rad or m)."""
    kind, frame = joint.get("type"), frame_of(joint)
    if kind not in ("revolute", "continuous", "prismatic"):
        return frame
    x, y, z = axis_of(joint)
    length = math.hypot(x, y, z)
    x, y, z = (position * part / length for part in (x, y, z))
    return frame.compose(
        Pose((x, y, z)) if kind == "prismatic" else Pose(ORIGIN.position, from_rotvec((x, y, z)))
    )


def put_origin(element: Element, pose: Pose) -> None:
    """Replace the ``origin`` of an element."""
    for old in element.findall("origin"):
        element.remove(old)
    SubElement(element, "origin", _origin(pose))


def _add_mass(link: Element, other: Element, mount: Pose) -> None:
    """Add another link's mass to a link, at their common centre; the inertia is Bullet's to compute.

    A link without ``<inertial>`` has no mass. Bullet would give it 1 kg.
    """
    own, added = link.find("inertial"), other.find("inertial")
    if added is None or mass_of(other) == 0.0:
        return
    if own is None:
        own = SubElement(link, "inertial")
        SubElement(own, "mass", value="0.0")
        SubElement(own, "inertia", _inertia(mass_of(other), (0.05, 0.05, 0.05)))
    total = mass_of(link) + mass_of(other)
    share = mass_of(other) / total
    pairs = zip(frame_of(own).position, mount.transform(frame_of(added).position), strict=True)
    x, y, z = ((1.0 - share) * here + share * there for here, there in pairs)
    own.findall("mass")[0].set("value", repr(total))
    put_origin(own, Pose((x, y, z)))


def mass_of(link: Element) -> float:
    """Return the mass (kg) of a link, 0 without ``<inertial>``."""
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else number_of(mass, "value")


def _origin(pose: Pose) -> dict[str, str]:
    return {"xyz": _text(pose.position), "rpy": _text(euler_angles(pose.orientation))}


def _inertia(mass: float, extents: Vector) -> dict[str, str]:
    x, y, z = (side * side for side in extents)
    diagonal = {"ixx": y + z, "iyy": x + z, "izz": x + y}
    values = {key: repr(mass / 12.0 * value) for key, value in diagonal.items()}
    return values | {"ixy": "0", "ixz": "0", "iyz": "0"}


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(value) for value in values)
