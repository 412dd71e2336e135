"""Tutorial 4: an arm of your own, in a module that processes can import."""

from functools import partial
from pathlib import Path

import pybullet_data

import bulletarm_gym
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import ParallelJaw, RobotModel, read_urdf

URDF = Path(pybullet_data.getDataPath(), "xarm", "xarm6_robot.urdf")
FLANGE = Pose((0.0, 0.0, 0.0))  # in link6, whose z axis is the approach
JAW = ParallelJaw(stroke=0.10, palm=(0.12, 0.06, 0.06), finger=(0.012, 0.02, 0.07))


def xarm6() -> RobotModel:
    """Return an xArm 6 with a jaw that opens by 10 cm."""
    return RobotModel(
        name="xarm6",
        load=partial(JAW.fitted, partial(read_urdf, URDF), "link6", FLANGE),
        joints=tuple(f"joint{number}" for number in range(1, 7)),
        tool=JAW.tool(FLANGE),
        gripper=JAW,
        base=Pose((0.05, 0.0, 0.1)),
        posture=(0.0, -0.3, -1.2, 0.0, 1.5, 0.0),
        force=(50.0, 50.0, 32.0, 32.0, 32.0, 20.0),  # N m, the efforts in the URDF
    )


bulletarm_gym.register_robot("xarm6", xarm6)
