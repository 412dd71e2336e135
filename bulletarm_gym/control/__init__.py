"""How the arm is commanded."""

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
    """Return the class of a control by its name, ours or registered, or by its path ``"module:Class"``.

    :return: a subclass of :class:`Control`, constructed with ``(config, robot, grasp_params)``
    :raises ValueError: there is no such control
    """
    found = find_class("control", name, CONTROLS, CONTROL_PATHS, Control)
    if getattr(found, "kind", None) not in CONTROLS:
        raise ValueError(
            f"control: {name} has kind={getattr(found, 'kind', None)!r}, takes one of {tuple(CONTROLS)}"
        )
    return found
