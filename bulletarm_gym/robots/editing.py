"""Changes of a robot's URDF: leaving out links, and attaching another model."""

from xml.etree.ElementTree import Element

from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots.checks import check_element
from bulletarm_gym.robots.structure import check_tree, find_root
from bulletarm_gym.robots.urdf import add_joint, end_of, find_link


def without(root: Element, *links: str) -> Element:
    """Remove links from a model, each with its joint and all that is attached to it.

    Leaves out the gripper that a flange carries in its file, for example.

    :param links: names of the links
    :return: the model
    :raises ValueError: the model has no such link
    """
    for name in links:
        removed = {find_link(root, name).get("name", "")}
        while True:
            joints = [joint for joint in root.findall("joint") if end_of(joint, "parent") in removed]
            if not joints:
                break
            for joint in joints:
                removed.add(end_of(joint, "child"))
                root.remove(joint)
        for joint in [joint for joint in root.findall("joint") if end_of(joint, "child") == name]:
            root.remove(joint)
        for link in [link for link in root.findall("link") if link.get("name") in removed]:
            root.remove(link)
    return root


def attach(root: Element, link: str, other: Element, mount: Pose) -> Element:
    """Attach another model to a link by a fixed joint: a gripper to the flange of an arm, for example.

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
