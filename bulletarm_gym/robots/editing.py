"""Changes of a robot's URDF: removed, attached and merged links, and slides for the fingers of a linkage."""

from functools import partial
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.geometry import Pose, conjugate, rotate
from bulletarm_gym.robots.checks import check_element, convert, names, number
from bulletarm_gym.simulation.urdf import (
    add_inertial,
    add_joint,
    children_of,
    end_of,
    find_joint,
    find_link,
    find_root,
    frame_of,
    mass_of,
    number_of,
    pose_at,
    put_origin,
)

FINGER_EFFORT, FINGER_SPEED = 50.0, 1.0
"""Limits (N, m/s) of a finger on a slide in the URDF. The gripper has its own."""


def without(root: Element, *links: str) -> Element:
    """Remove links with everything attached to them, a gripper in the file of an arm for example.

    :param root: the model, which is changed
    :param links: names of the links
    :return: the model
    :raises ValueError: the model has no such link
    """
    for name in links:
        link = find_link(root, name)
        _remove_attached(root, name)
        for joint in [joint for joint in root.findall("joint") if end_of(joint, "child") == name]:
            root.remove(joint)
        root.remove(link)
    return root


def _remove_attached(root: Element, link: str, kept: tuple[str, ...] = ()) -> None:
    """Remove all joints and links attached to a link, except some links."""
    for joint in children_of(root, link):
        child = end_of(joint, "child")
        root.remove(joint)
        _remove_attached(root, child, kept)
        if child not in kept:
            root.remove(find_link(root, child))


def attach(root: Element, link: str, other: Element, mount: Pose) -> Element:
    """Attach another model to a link by a fixed joint, a gripper to the flange of an arm for example.

    :param root: the model, which is changed
    :param link: name of the link that carries the other model
    :param other: the model to attach
    :param mount: pose of the other model's root link in the link
    :return: the model
    :raises ValueError: there is no such link, ``other`` is not the element ``<robot>``, or both models use
        the same name for a link or a joint
    """
    check_element("other", other)
    find_link(root, link)
    base = find_root(other).get("name", "")
    materials = {material.get("name") for material in root.findall("material")}
    root.extend(material for material in other.findall("material") if material.get("name") not in materials)
    root.extend([*other.findall("link"), *other.findall("joint")])
    add_joint(root, "fixed", f"{link}_{base}_mount", (link, base), mount, (1.0, 0.0, 0.0))
    check_tree(root)
    return root


def check_tree(root: Element) -> None:
    """Raise ValueError if a model is not a tree of links with distinct names."""
    for kind in ("link", "joint"):
        if repeated := _repeated([element.get("name", "") for element in root.findall(kind)]):
            raise ValueError(f"names of {kind}s must be distinct, got {repeated} twice")
    for joint in root.findall("joint"):
        for end in ("parent", "child"):
            find_link(root, end_of(joint, end))
    if repeated := _repeated([end_of(joint, "child") for joint in root.findall("joint")]):
        raise ValueError(f"each link must have one parent, got several for {repeated}")
    find_root(root)


def _repeated(found: list[str]) -> str:
    return ", ".join(repr(name) for name in dict.fromkeys(found) if found.count(name) > 1)


def merge_fixed(root: Element) -> None:
    """Merge links on fixed joints into their parents. Bullet simulates them as slowly as moving links."""
    for joint in root.findall("joint[@type='fixed']"):
        parent, child = (find_link(root, end_of(joint, end)) for end in ("parent", "child"))
        mount = frame_of(joint)
        _add_mass(parent, child, mount)
        shapes = [*child.findall("visual"), *child.findall("collision")]
        attached = children_of(root, child.get("name", ""))
        for element in [*shapes, *attached]:
            put_origin(element, mount.compose(frame_of(element)))
        parent.extend(shapes)
        for other in attached:
            other.findall("parent")[0].set("link", end_of(joint, "parent"))
        root.remove(joint)
        root.remove(child)


def _add_mass(link: Element, other: Element, mount: Pose) -> None:
    """Add the mass of another link at the common centre of mass. Bullet computes the inertia.

    A link without ``<inertial>`` has no mass here, and 1 kg in Bullet.
    """
    added = other.find("inertial")
    if added is None or mass_of(other) == 0.0:
        return
    if link.find("inertial") is None:
        add_inertial(link, Pose((0.0, 0.0, 0.0)), 0.0, (mass_of(other) * 0.05**2 / 6.0 * np.eye(3)).tolist())
    own = link.findall("inertial")[0]
    total = mass_of(link) + mass_of(other)
    share = mass_of(other) / total
    pairs = zip(frame_of(own).position, mount.transform(frame_of(added).position), strict=True)
    x, y, z = ((1.0 - share) * first + share * second for first, second in pairs)
    own.findall("mass")[0].set("value", repr(total))
    put_origin(own, Pose((x, y, z)))


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
    :raises ValueError: a joint or the carrier is missing or not attached, ``opened`` does not open the
        fingers, or a position is not a number
    """
    joints = convert("fingers", fingers, "a tuple of 2 names", partial(names, count=2))
    closed = convert("closed", closed, "a finite number", number)
    opened = convert("opened", opened, "a finite number", number)
    met = [_finger_pose(root, carrier, name, closed) for name in joints]
    apart = [_finger_pose(root, carrier, name, opened) for name in joints]
    across = np.subtract(apart[0].position, apart[1].position)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    children = tuple(end_of(find_joint(root, name), "child") for name in joints)
    _remove_attached(root, carrier, kept=children)
    for index, outwards in enumerate((across, -across)):
        x, y, z = outwards.tolist()
        travel = float(np.subtract(apart[index].position, met[index].position) @ outwards)
        if travel <= 0.0:
            raise ValueError(
                f"opened must move the finger {joints[index]!r} outwards from closed={closed:g}, "
                f'got {opened:g}. Add <mimic multiplier="-1"/> to a joint that moves against the driving one.'
            )
        axis = rotate(conjugate(met[index].orientation), (x, y, z))
        links, limits = (carrier, children[index]), (0.0, travel)
        kind, name = "prismatic", joints[index]
        add_joint(root, kind, name, links, met[index], axis, limits, FINGER_EFFORT, FINGER_SPEED)
    return root


def _finger_pose(root: Element, carrier: str, finger: str, driven: float) -> Pose:
    """Return the pose of a finger in its carrier at a position (rad or m) of the driving joint."""
    carrier = find_link(root, carrier).get("name", "")
    joint = find_joint(root, finger)
    pose = pose_at(joint, _position(joint, driven))
    while (parent := end_of(joint, "parent")) != carrier:
        before = [other for other in root.findall("joint") if end_of(other, "child") == parent]
        if not before:
            raise ValueError(f"the joint {finger!r} is not attached to the link {carrier!r}")
        joint = before[0]
        pose = pose_at(joint, _position(joint, driven)).compose(pose)
    return pose


def _position(joint: Element, driven: float) -> float:
    """Return the position of a joint that follows the driving joint by ``<mimic>``."""
    mimic = joint.find("mimic")
    if mimic is None:
        return driven
    return number_of(mimic, "multiplier", "1") * driven + number_of(mimic, "offset")
