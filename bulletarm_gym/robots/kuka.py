"""KUKA LBR iiwa 14 R820 with a parallel gripper."""

import math
from functools import partial

from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots.gripper import ParallelJaw
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.simulation.urdf import load_model

FLANGE = Pose((0.0, 0.0, 0.045))
"""Pose of the flange in the last link (m; iiwa 7 R800 data sheet: 126 mm from the wrist centre)."""
JAW = ParallelJaw(stroke=0.085, palm=(0.125, 0.055, 0.06), finger=(0.012, 0.019, 0.09))

KUKA = RobotModel(
    name="kuka",
    load=partial(JAW.fitted, partial(load_model, "kuka_iiwa/model.urdf"), "lbr_iiwa_link_7", FLANGE),
    joints=tuple(f"lbr_iiwa_joint_{number}" for number in range(1, 8)),
    # With the jaw rotated by pi, joint 7 is at 0 at the home pose.
    tool=JAW.tool(FLANGE).compose(Pose.planar(0.0, 0.0, 0.0, math.pi)),
    gripper=JAW,
    base=Pose((-0.14, 0.0, 0.1)),
    posture=(0.0, 0.6, 0.0, -1.8, 0.0, math.pi - 2.4, 0.0),
    force=(320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),
)
"""Joint limits and torques from the data sheet."""
