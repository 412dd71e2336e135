"""Franka Emika Panda with its gripper."""

import math
from xml.etree.ElementTree import Element

from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.robots.editing import LIGHT, box
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.simulation.urdf import find, load_model

FINGERS = ("panda_leftfinger", "panda_rightfinger")
PAD = box((0.0175, 0.0143, 0.0358), (0.0, 0.00715, 0.0359), LIGHT)
"""Box around the pad in the mesh of the left finger. Its y axis points outwards, its z axis to the tip."""
ROOT = box((0.0208, 0.0236, 0.019), (0.0, 0.0145, 0.0095), LIGHT)
"""Box around the rest of this mesh."""
JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
LIMITS = (
    (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
)
"""Joint limits (rad; Franka Control Interface documentation). The limits in pybullet_data are wider."""


def _load() -> Element:
    root = load_model("franka_panda/panda.urdf")
    for name, lower, upper in zip(JOINTS, *LIMITS, strict=True):
        find(root, "joint", name).findall("limit")[0].attrib.update(lower=repr(lower), upper=repr(upper))
    for name, yaw in zip(FINGERS, (0.0, math.pi), strict=True):
        finger = find(root, "link", name)
        # Boxes have four contact points a face, and no soft contacts, as the grippers of the other arms.
        for element in [*finger.findall("collision"), *finger.findall("contact")]:
            finger.remove(element)
        for part in (PAD, ROOT):
            part.add_to(finger, Pose.planar(0.0, 0.0, 0.0, yaw), visible=False)
    return root


PANDA = RobotModel(
    name="panda",
    load=_load,
    joints=JOINTS,
    # Flange, finger mount and finger mesh. The gripper is rotated by -pi/4 and opens along its y axis.
    tool=euler_pose((0.0, 0.0, 0.107 + 0.0584 + 0.0538), (math.pi, 0.0, math.pi / 4.0)),
    gripper=Gripper(
        joints=("panda_finger_joint1", "panda_finger_joint2"),
        stroke=0.08,
        finger=(0.014, 0.0175, 0.0462),
        palm=(0.204, 0.063, 0.092),  # the hull of its mesh, which ends 46.2 mm above the fingertips
        shoulder=(0.0263, 0.0538 - 0.019),
    ),
    base=Pose((-0.06, 0.0, 0.0)),
    posture=(0.0, 0.0, 0.0, -2.2, 0.0, 2.2, -math.pi / 4.0),
    force=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
)
"""Torques from the data sheet."""
