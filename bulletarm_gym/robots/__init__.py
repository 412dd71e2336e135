"""Who acts: arms with their grippers."""

from collections.abc import Callable

from bulletarm_gym.config import ParameterError
from bulletarm_gym.extensions import produce
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
"""The arms that the parameter ``robot`` takes."""


def find_robot(source: str | RobotModel | Callable[[], RobotModel]) -> RobotModel:
    """Return an arm.

    :param source: the name of one of :data:`ROBOTS`, a user's model, the function that makes it, or the
        import path ``"module:name"`` of either
    :raises ParameterError: nothing is found there, or something else
    """
    known = ROBOTS.get(source) if isinstance(source, str) else None
    try:
        model = known or produce(source, RobotModel)
    except (TypeError, ValueError) as error:  # TypeError: a function that takes arguments
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
