"""Who acts: arms with their grippers."""

from bulletarm_gym.robots.editing import attach, without
from bulletarm_gym.robots.gripper import Gripper, ParallelJaw
from bulletarm_gym.robots.kuka import KUKA
from bulletarm_gym.robots.linkage import on_slides
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.panda import PANDA
from bulletarm_gym.robots.robot import OutOfReachError, Robot, RobotState
from bulletarm_gym.robots.ur5 import UR5, UR5_ROBOTIQ
from bulletarm_gym.simulation.assets import read_urdf

ROBOTS = {model.name: model for model in (KUKA, PANDA, UR5, UR5_ROBOTIQ)}
"""Built-in robots, by name."""

__all__ = [
    "KUKA",
    "PANDA",
    "ROBOTS",
    "UR5",
    "UR5_ROBOTIQ",
    "Gripper",
    "OutOfReachError",
    "ParallelJaw",
    "Robot",
    "RobotModel",
    "RobotState",
    "attach",
    "on_slides",
    "read_urdf",
    "without",
]
