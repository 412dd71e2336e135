"""Controls map actions to motions of the robot."""

from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.control.close_loop import CloseLoop, DeltaMove
from bulletarm_gym.control.control import Control, GraspParams, Outcome
from bulletarm_gym.control.heights import Grasp
from bulletarm_gym.control.interface import RobotInterface
from bulletarm_gym.control.open_loop import OpenLoop, PickPlace
from bulletarm_gym.extensions import CONTROL_PATHS, find_class

CONTROLS: dict[str, type[Any]] = {CLOSE_LOOP: CloseLoop, OPEN_LOOP: OpenLoop}

__all__ = [
    "CONTROLS",
    "CloseLoop",
    "Control",
    "DeltaMove",
    "Grasp",
    "GraspParams",
    "OpenLoop",
    "Outcome",
    "PickPlace",
    "RobotInterface",
    "find_control",
]


def find_control(name: str) -> type[Any]:
    """Return the class of a control by its registered name or by its path ``"module:Class"``.

    :return: a subclass of :class:`Control`, constructed with ``(config, robot, grasp_params)``
    :raises ValueError: no such control exists
    """
    found = find_class("control", name, CONTROLS, CONTROL_PATHS, Control)
    kind = getattr(found, "kind", None)
    if kind not in CONTROLS:
        raise ValueError(f"control: {name} must have a kind of {tuple(CONTROLS)}, got {kind!r}")
    return found
