"""Universal Robots UR5 of primitives, with a parallel jaw or a Robotiq 2F-85. Sources are in ``ur5.urdf``."""

import math
from functools import partial
from pathlib import Path

from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.robots.editing import DARK, RGB, box, cylinder
from bulletarm_gym.robots.gripper import ParallelJaw
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.simulation.urdf import read_urdf

BLACK: RGB = (0.16, 0.16, 0.17)
GREY: RGB = (0.45, 0.46, 0.48)
QUARTER = math.pi / 2.0
FLANGE = euler_pose((0.0, 0.0823, 0.0), (-QUARTER, 0.0, 0.0))
"""Pose of the flange in the last link, whose y axis is the approach."""
JAW = ParallelJaw(stroke=0.075, palm=(0.11, 0.05, 0.055), finger=(0.005, 0.025, 0.06))
ROBOTIQ_2F85 = ParallelJaw(
    stroke=0.085,
    palm=(0.07, 0.05, 0.08),
    finger=(0.012, 0.022, 0.07),
    colour=BLACK,
    housing=(
        cylinder(0.0375, 0.02, (0.0, 0.0, 0.01), GREY, solid=False),
        cylinder(0.037, 0.045, (0.0, 0.0, 0.0425), BLACK, solid=False),
        box((0.086, 0.036, 0.03), (0.0, 0.0, 0.063), DARK, solid=False),
    ),
    trim=(
        box((0.011, 0.028, 0.066), (0.008, 0.0, 0.002), GREY, tilt=0.6, solid=False),
        box((0.012, 0.024, 0.042), (0.0185, 0.0, 0.034), BLACK, tilt=-0.4, solid=False),
        box((0.004, 0.0226, 0.036), (0.0021, 0.0, 0.0525), GREY, solid=False),
    ),
)
"""Stroke of the data sheet. The fingers slide, because linkages of position-driven joints hold no objects."""
OFFSET = 0.25
"""Rotation (rad) of the shoulder relative to the fingertips: the wrist is 0.109 m from the arm's plane."""
LIFT, ELBOW = -1.3, 1.9
"""Positions (rad) of the second and third joint in the posture."""


def _model(name: str, jaw: ParallelJaw) -> RobotModel:
    arm = partial(read_urdf, Path(__file__).with_name("ur5.urdf"))
    joints = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
    return RobotModel(
        name=name,
        load=partial(jaw.fitted, arm, "wrist_3", FLANGE),
        joints=tuple(f"{joint}_joint" for joint in joints),
        tool=jaw.tool(FLANGE),
        gripper=jaw,
        base=Pose((-0.08, 0.0, 0.2)),
        posture=(-OFFSET, LIFT, ELBOW, -QUARTER - LIFT - ELBOW, -QUARTER, -QUARTER - OFFSET),
        force=(150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
    )


UR5, UR5_ROBOTIQ = _model("ur5", JAW), _model("ur5_robotiq", ROBOTIQ_2F85)
