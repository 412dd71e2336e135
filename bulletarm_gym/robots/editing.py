"""Changes of a robot's URDF: removed and attached links, and slides for the fingers of a linkage."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from bulletarm_gym.config_checks import check_argument, check_fields, choice, numbers
from bulletarm_gym.geometry import Pose, Vector, conjugate, euler_pose, rotate
from bulletarm_gym.geometry.poses import pose_check
from bulletarm_gym.simulation import urdf


def joints_below(root: Element, link: str) -> list[Element]:
    """Return the joints of all links that are attached to a link."""
    found = []
    for joint in urdf.children_of(root, link):
        found += [joint, *joints_below(root, urdf.end_of(joint, "child"))]
    return found


def without(root: Element, *links: str) -> Element:
    """Remove links with everything attached to them, a gripper in the file of an arm for example.

    :param root: the model, which is changed
    :param links: names of the links
    :return: the model
    :raises ValueError: the model has no such link, or is not the element ``<robot>``
    """
    check_element("root", root)
    for name in links:
        link = urdf.find(root, "link", name)
        _remove_attached(root, name)
        for joint in [joint for joint in root.findall("joint") if urdf.end_of(joint, "child") == name]:
            root.remove(joint)
        root.remove(link)
    return root


def _remove_attached(root: Element, link: str, kept: tuple[str, ...] = ()) -> None:
    """Remove all joints and links attached to a link, except some links."""
    for joint in joints_below(root, link):
        root.remove(joint)
        if (child := urdf.end_of(joint, "child")) not in kept:
            root.remove(urdf.find(root, "link", child))


def check_element(name: str, value: object) -> None:
    """Raise ValueError if a value is not the root element of a URDF."""
    if not (isinstance(value, Element) and value.tag == "robot"):
        raise ValueError(f"{name} must be the element <robot> of a URDF, got {value!r}. Use read_urdf().")


def attach(root: Element, link: str, other: Element, mount: Pose) -> Element:
    """Attach another model to a link by a fixed joint, a gripper to the flange of an arm for example.

    :param root: the model, which is changed
    :param link: name of the link that carries the other model
    :param other: the model to attach
    :param mount: pose of the other model's root link in the link
    :return: the model
    :raises ValueError: there is no such link, or a model is not the element ``<robot>``
    """
    for name, model in (("root", root), ("other", other)):
        check_element(name, model)
    mount = check_argument("mount", mount, pose_check)
    urdf.find(root, "link", link)
    base = urdf.find_root(other).get("name", "")
    materials = {material.get("name") for material in root.findall("material")}
    root.extend(material for material in other.findall("material") if material.get("name") not in materials)
    root.extend([*other.findall("link"), *other.findall("joint")])
    urdf.add_joint(root, "fixed", f"{link}_{base}_mount", (link, base), mount, (1.0, 0.0, 0.0))
    return root


def on_slides(
    root: Element, carrier: str, fingers: tuple[str, str], closed: float, opened: float = 0.0
) -> Element:
    """Replace the linkage of two parallel fingers by prismatic joints, which are 0 where the fingers meet.

    A linkage of position-driven joints does not hold objects. Its other links are removed.

    :param root: the model, which is changed
    :param carrier: name of the link that carries the linkage
    :param fingers: names of the joints that move the fingers
    :param closed: position (rad, or m of a prismatic joint) of the driving joint where the fingers meet;
        joints with ``<mimic>`` follow it
    :param opened: position of the driving joint where the fingers are open
    :return: the model
    :raises ValueError: a joint or the carrier is missing or not attached, or ``opened`` does not open the
        fingers
    """
    check_element("root", root)
    urdf.find(root, "link", carrier)
    children = tuple(urdf.end_of(urdf.find(root, "joint", name), "child") for name in fingers)
    met = [_pose_in(root, carrier, child, closed) for child in children]
    apart = [_pose_in(root, carrier, child, opened) for child in children]
    across = np.subtract(apart[0].position, apart[1].position)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    _remove_attached(root, carrier, kept=children)
    for index, outwards in enumerate((across, -across)):
        x, y, z = outwards.tolist()
        travel = float(np.subtract(apart[index].position, met[index].position) @ outwards)
        if not travel > 0.0:
            raise ValueError(
                f"opened must move the finger {fingers[index]!r} outwards from closed={closed:g}, "
                f'got {opened:g}. Add <mimic multiplier="-1"/> to a joint that moves against the driving one.'
            )
        axis = rotate(conjugate(met[index].orientation), (x, y, z))
        links = (carrier, children[index])
        urdf.add_joint(root, "prismatic", fingers[index], links, met[index], axis, (0.0, travel))
    return root


def _pose_in(root: Element, carrier: str, link: str, driven: float) -> Pose:
    """Return the pose of a link in a carrier at a position (rad or m) of the driving joint."""
    if link == carrier:
        return Pose((0.0, 0.0, 0.0))
    joint = next((joint for joint in root.findall("joint") if urdf.end_of(joint, "child") == link), None)
    if joint is None:
        raise ValueError(f"fingers must be attached to the link {carrier!r}, got one attached to {link!r}")
    mimic, position = joint.find("mimic"), driven
    if mimic is not None:
        position = urdf.number_of(mimic, "multiplier", "1") * driven + urdf.number_of(mimic, "offset")
    return _pose_in(root, carrier, urdf.end_of(joint, "parent"), driven).compose(
        urdf.pose_at(joint, position)
    )


RGB: TypeAlias = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

DARK: RGB = (0.25, 0.25, 0.27)
LIGHT: RGB = (0.55, 0.57, 0.60)


@dataclass(frozen=True)
class Primitive:
    """A box, or a cylinder along its z axis.

    :param kind: ``"box"`` or ``"cylinder"``
    :param extents: side lengths (m) of the bounding box
    :param pose: pose of the centre in the link
    :param solid: whether it collides; if False it is only rendered
    """

    kind: str
    extents: Vector
    pose: Pose
    colour: RGB
    solid: bool = True

    def __post_init__(self) -> None:
        kind, extents = choice("box", "cylinder"), numbers("positive", 3)
        check_fields(self, {"kind": kind, "extents": extents, "pose": pose_check})

    def add_to(self, link: Element, frame: Pose | None = None, visible: bool = True) -> None:
        """Add the visual and the collision element to a link, at a pose in a frame of the link."""
        pose = self.pose if frame is None else frame.compose(self.pose)
        x, _, z = self.extents
        size = {"radius": repr(x / 2.0), "length": repr(z)}
        if self.kind == "box":
            size = {"size": urdf.text_of(self.extents)}
        if visible:
            urdf.add_geometry(link, "visual", self.kind, size, pose, (*self.colour, 1.0))
        if self.solid:
            urdf.add_geometry(link, "collision", self.kind, size, pose)


def box(extents: Vector, centre: Vector, colour: RGB, tilt: float = 0.0, solid: bool = True) -> Primitive:
    """Return a box (m), rotated by ``tilt`` (rad) about its y axis."""
    return Primitive("box", extents, euler_pose(centre, (0.0, tilt, 0.0)), colour, solid)


def cylinder(radius: float, length: float, centre: Vector, colour: RGB, solid: bool = True) -> Primitive:
    """Return a cylinder (m) along the z axis of the link."""
    return Primitive("cylinder", (2.0 * radius, 2.0 * radius, length), Pose(centre), colour, solid)


def add_link(root: Element, name: str, mass: float, primitives: Sequence[Primitive]) -> None:
    """Add a link of primitives with its mass (kg) at the centre of the first one.

    Bullet computes the inertia from the collision shapes.
    """
    link = SubElement(root, "link", name=name)
    urdf.add_inertial(link, primitives[0].pose, mass, np.eye(3).tolist())
    for primitive in primitives:
        primitive.add_to(link)
