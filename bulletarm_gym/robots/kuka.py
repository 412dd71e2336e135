"""KUKA LBR iiwa with a parallel gripper."""

import math
from functools import partial

from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots.gripper import ParallelJaw
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.simulation.assets import load_model

FLANGE_OFFSET = 0.045
"""From the last link's origin to the flange (m; iiwa 7 R800 data sheet: 126 mm from the wrist centre)."""

KUKA = RobotModel(
    name="kuka",
    arm=partial(load_model, "kuka_iiwa/model.urdf"),
    joints=tuple(f"lbr_iiwa_joint_{number}" for number in range(1, 8)),
    flange_link="lbr_iiwa_link_7",
    flange=Pose((0.0, 0.0, FLANGE_OFFSET)),
    gripper=ParallelJaw(),
    base=Pose((0.0, 0.0, 0.0)),
    posture=(0.0, 0.6, 0.0, -1.8, 0.0, math.pi - 2.4, math.pi),
    force=300.0,
)
"""Greatest torque as in the model of pybullet_data."""
