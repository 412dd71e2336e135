"""Robots: arms with grippers, and tools for the models of users."""

from bulletarm_gym.robots.arm import OutOfReachError
from bulletarm_gym.robots.editing import attach, on_slides, without
from bulletarm_gym.robots.gripper import Gripper, ParallelJaw
from bulletarm_gym.robots.kuka import KUKA
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.panda import PANDA
from bulletarm_gym.robots.robot import Robot, RobotState
from bulletarm_gym.robots.ur5 import UR5, UR5_ROBOTIQ
from bulletarm_gym.simulation.urdf import read_urdf

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
