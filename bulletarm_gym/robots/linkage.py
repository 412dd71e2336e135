"""Grippers whose fingers hang on a linkage, put on slides."""

from xml.etree.ElementTree import Element, SubElement

import numpy as np

from bulletarm_gym.geometry import Pose, conjugate, rotate
from bulletarm_gym.robots.kinematics import Chain, find_joint
from bulletarm_gym.robots.urdf import ORIGIN, add_joint, end_of, find_link

EFFORT, SPEED = "50", "1"
"""Limits of a finger in the model (N, m/s); what moves it is what the gripper says."""


def on_slides(root: Element, carrier: str, fingers: tuple[str, str], closed: float) -> Element:
    """Put two fingers that a linkage moves in parallel on slides of their own.

    What a linkage of position-driven joints grasps it does not hold. Each finger's joint becomes a prismatic
    one of the carrier, 0 where the fingers meet, which takes it straight outwards as far as the linkage does
    from there to where all its joints are at 0. The rest of the linkage is left out.

    :param root: the model, which is changed
    :param carrier: name of the link that the linkage is mounted on
    :param fingers: names of the joints that move the fingers in the linkage
    :param closed: position (rad) of the linkage's driving joint where the fingers meet; joints with a
        ``mimic`` follow it as they say
    :return: the model
    :raises ValueError: a finger's joint or the carrier is missing, or the one does not hang on the other
    """
    met = [_pose(root, carrier, name, closed) for name in fingers]
    apart = [_pose(root, carrier, name, 0.0) for name in fingers]
    across = np.subtract(apart[0].position, apart[1].position)
    across /= np.linalg.norm(across)
    children = [end_of(find_joint(root, name), "child") for name in fingers]
    _clear(root, carrier, children)
    for number, outwards in enumerate((across, -across)):
        x, y, z = outwards.tolist()
        travel = float(np.subtract(apart[number].position, met[number].position) @ outwards)
        axis = rotate(conjugate(met[number].orientation), (x, y, z))
        links = (carrier, children[number])
        slide = add_joint(root, "prismatic", fingers[number], links, met[number], axis)
        SubElement(slide, "limit", lower="0", upper=repr(travel), effort=EFFORT, velocity=SPEED)
    return root


def _pose(root: Element, carrier: str, finger: str, driven: float) -> Pose:
    """Return where a finger is in its carrier when the driving joint is at a position (rad)."""
    way = [find_joint(root, finger)]
    while (parent := end_of(way[0], "parent")) != find_link(root, carrier).get("name"):
        before = [joint for joint in root.findall("joint") if end_of(joint, "child") == parent]
        if not before:
            raise ValueError(f"the joint {finger!r} does not hang on the link {carrier!r}")
        way = [*before, *way]
    chain = Chain.from_urdf(root, [joint.get("name", "") for joint in way], ORIGIN, ORIGIN)
    return chain.forward(np.array([_position(joint, driven) for joint in way]))


def _position(joint: Element, driven: float) -> float:
    mimic = joint.find("mimic")
    if mimic is None:
        return driven
    return float(mimic.get("multiplier", "1")) * driven + float(mimic.get("offset", "0"))


def _clear(root: Element, link: str, kept: list[str]) -> None:
    """Remove everything that hangs on a link, joints and links, but some links."""
    for joint in [joint for joint in root.findall("joint") if end_of(joint, "parent") == link]:
        child = end_of(joint, "child")
        _clear(root, child, kept)
        root.remove(joint)
        if child not in kept:
            root.remove(find_link(root, child))
