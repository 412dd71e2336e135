"""Franka Emika Panda with its own hand."""

import math
from xml.etree.ElementTree import Element

from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.robots.kinematics import find_joint
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.urdf import LIGHT, box, find_link
from bulletarm_gym.simulation.assets import load_model

FINGERTIPS = 0.107 + 0.0584 + 0.0538
"""From the last link's origin (m): the flange, the fingers' mount in the hand, and the finger mesh."""
HAND_YAW = -math.pi / 4.0
"""Of the hand about the flange."""
FINGERS = ("panda_leftfinger", "panda_rightfinger")
PAD = box((0.0175, 0.0143, 0.0358), (0.0, 0.00715, 0.0359), LIGHT)
PALM = (0.204, 0.063, 0.092)
"""Side lengths (m) of the hull of the hand's mesh; it ends 46.2 mm above the fingertips."""
ROOT = box((0.0208, 0.0236, 0.019), (0.0, 0.0145, 0.0095), LIGHT)
"""The two boxes that the mesh of the left finger fills; y points outwards, z to the tip."""


JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
LIMITS = (
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (-0.0175, 3.7525),
    (-2.8973, 2.8973),
)
"""Joint limits (rad; Franka Control Interface documentation); those of pybullet_data's model are wider."""


def _load() -> Element:
    root = load_model("franka_panda/panda.urdf")
    for name, (lower, upper) in zip(JOINTS, LIMITS, strict=True):
        limit = find_joint(root, name).findall("limit")[0]
        limit.set("lower", repr(lower))
        limit.set("upper", repr(upper))
    for name, yaw in zip(FINGERS, (0.0, math.pi), strict=True):
        _square(find_link(root, name), Pose.planar(0.0, 0.0, 0.0, yaw))
    return root


def _square(finger: Element, frame: Pose) -> None:
    """Let a finger touch with boxes, four points a face, instead of with the hull of its mesh.

    The model's soft contacts go too, so that the grippers of all arms touch alike.
    """
    for element in [*finger.findall("collision"), *finger.findall("contact")]:
        finger.remove(element)
    finger.extend(part.seen_from(frame).element("collision") for part in (PAD, ROOT))


PANDA = RobotModel(
    name="panda",
    load=_load,
    joints=JOINTS,
    # The fingers open along the hand's y axis.
    tool=euler_pose((0.0, 0.0, FINGERTIPS), (math.pi, 0.0, HAND_YAW + math.pi / 2.0)),
    gripper=Gripper(
        joints=("panda_finger_joint1", "panda_finger_joint2"),
        stroke=0.08,
        finger=(0.014, 0.0175, 0.0462),
        palm=PALM,
        shoulder=(0.0263, 0.0538 - 0.019),
    ),
    base=Pose((-0.06, 0.0, 0.0)),
    posture=(0.0, 0.0, 0.0, -2.2, 0.0, 2.2, -math.pi / 4.0),
    force=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
)
"""Torques of the data sheet."""
