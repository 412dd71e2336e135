"""Grippers whose fingers hang on a linkage, put on slides."""

from xml.etree.ElementTree import Element, SubElement

import numpy as np

from bulletarm_gym.config_checks import check_argument
from bulletarm_gym.geometry import Pose, conjugate, rotate
from bulletarm_gym.robots.checks import finite, names
from bulletarm_gym.robots.kinematics import find_joint
from bulletarm_gym.robots.urdf import add_joint, end_of, find_link, pose_at

EFFORT, SPEED = "50", "1"
"""Limits of a finger in the model (N, m/s); what moves it is what the gripper says."""


def on_slides(
    root: Element, carrier: str, fingers: tuple[str, str], closed: float, opened: float = 0.0
) -> Element:
    """Put two fingers that a linkage moves in parallel on slides of their own.

    A linkage of position-driven joints does not hold objects. Each finger's joint becomes a prismatic joint
    of the carrier, 0 where the fingers meet. The rest of the linkage is left out.

    :param root: the model, which is changed
    :param carrier: name of the link that the linkage is mounted on
    :param fingers: names of the joints that move the fingers in the linkage
    :param closed: position (rad, or m of a prismatic joint) of the linkage's driving joint where the fingers
        meet; joints with a ``mimic`` follow it as they say, fixed joints stay
    :param opened: its position where the fingers are open
    :return: the model
    :raises ValueError: a joint or the carrier is missing or not attached, ``opened`` opens nothing, or a
        position is not a number
    """
    fingers = check_argument("fingers", fingers, names(2))
    for name, value in (("closed", closed), ("opened", opened)):
        check_argument(name, value, finite)
    met = [_pose(root, carrier, name, closed) for name in fingers]
    apart = [_pose(root, carrier, name, opened) for name in fingers]
    across = np.subtract(apart[0].position, apart[1].position)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    children = [end_of(find_joint(root, name), "child") for name in fingers]
    _clear(root, carrier, children)
    for number, outwards in enumerate((across, -across)):
        x, y, z = outwards.tolist()
        travel = float(np.subtract(apart[number].position, met[number].position) @ outwards)
        if travel <= 0.0:
            raise ValueError(
                f"opened must move the finger {fingers[number]!r} outwards from closed={closed:g}, "
                f'got {opened:g}. Add <mimic multiplier="-1"/> to a joint that moves against the driving one.'
            )
        axis = rotate(conjugate(met[number].orientation), (x, y, z))
        slide = add_joint(root, "prismatic", fingers[number], (carrier, children[number]), met[number], axis)
        SubElement(slide, "limit", lower="0", upper=repr(travel), effort=EFFORT, velocity=SPEED)
    return root


def _pose(root: Element, carrier: str, finger: str, driven: float) -> Pose:
    """Return where a finger is in its carrier when the driving joint is at a position (rad or m)."""
    joint = find_joint(root, finger)
    pose = pose_at(joint, _position(joint, driven))
    while (parent := end_of(joint, "parent")) != find_link(root, carrier).get("name"):
        before = [other for other in root.findall("joint") if end_of(other, "child") == parent]
        if not before:
            raise ValueError(f"the joint {finger!r} does not hang on the link {carrier!r}")
        joint = before[0]
        pose = pose_at(joint, _position(joint, driven)).compose(pose)
    return pose


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
