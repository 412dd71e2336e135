"""Who acts: arms with their grippers."""

from bulletarm_gym.extensions import produce
from bulletarm_gym.robots.gripper import Gripper, ParallelJaw
from bulletarm_gym.robots.kuka import KUKA
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.panda import PANDA
from bulletarm_gym.robots.robot import OutOfReachError, Robot, RobotState
from bulletarm_gym.robots.ur5 import UR5, UR5_ROBOTIQ

ROBOTS = {model.name: model for model in (KUKA, PANDA, UR5, UR5_ROBOTIQ)}
"""The arms that the parameter ``robot`` takes."""


def find_robot(name: str) -> RobotModel:
    """Return one of :data:`ROBOTS`, or a user's arm by its import path ``"module:name"``.

    :raises ValueError: nothing is found there, or something else
    """
    model = ROBOTS[name] if name in ROBOTS else produce(name, RobotModel)
    assert isinstance(model, RobotModel)
    return model


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
    "find_robot",
]
