"""Robots: arms with grippers, and tools for the models of users."""

from bulletarm_gym.robots.arm import OutOfReachError as OutOfReachError
from bulletarm_gym.robots.editing import attach as attach, on_slides as on_slides, without as without
from bulletarm_gym.robots.gripper import Gripper as Gripper, ParallelJaw as ParallelJaw
from bulletarm_gym.robots.kuka import KUKA as KUKA
from bulletarm_gym.robots.model import RobotModel as RobotModel
from bulletarm_gym.robots.panda import PANDA as PANDA
from bulletarm_gym.robots.robot import Robot as Robot, RobotState as RobotState
from bulletarm_gym.robots.ur5 import UR5 as UR5, UR5_ROBOTIQ as UR5_ROBOTIQ
from bulletarm_gym.simulation.urdf import read_urdf as read_urdf

ROBOTS = {model.name: model for model in (KUKA, PANDA, UR5, UR5_ROBOTIQ)}
"""Built-in robots, by name."""
