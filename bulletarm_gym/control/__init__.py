"""Controls map actions to motions of the robot."""

from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.control.close_loop import CloseLoop, DeltaMove
from bulletarm_gym.control.control import Control, GraspParams, Outcome, RobotInterface
from bulletarm_gym.control.open_loop import Grasp, OpenLoop, PickPlace

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
]
