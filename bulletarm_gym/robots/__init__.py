"""Robots: arms with grippers, and tools for the models of users."""

from collections.abc import Callable

from bulletarm_gym.config import ParameterError
from bulletarm_gym.extensions import produce
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
"""Built-in robots: names that the parameter ``robot`` accepts."""


def find_robot(source: str | RobotModel | Callable[[], RobotModel]) -> RobotModel:
    """Return a robot model.

    :param source: name in :data:`ROBOTS`, model, function that returns a model, or import path
        ``"module:name"`` of either
    :raises ParameterError: the source is not a robot model
    """
    known = ROBOTS.get(source) if isinstance(source, str) else None
    try:
        model = known or produce(source, RobotModel)
    except (TypeError, ValueError) as error:  # TypeError: a function with arguments
        takes = f"one of {', '.join(map(repr, ROBOTS))}, a model of your own or 'module:name': {error}"
        raise ParameterError.of("robot", source, takes) from error
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
    "attach",
    "find_robot",
    "on_slides",
    "read_urdf",
    "without",
]
