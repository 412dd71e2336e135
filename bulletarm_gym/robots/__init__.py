"""Who acts: arms with their grippers."""

from bulletarm_gym.robots.kuka import KUKA
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.robot import Robot, RobotState

ROBOTS = {model.name: model for model in (KUKA,)}
"""The arms that the parameter ``robot`` takes."""

__all__ = ["KUKA", "ROBOTS", "Robot", "RobotModel", "RobotState"]
