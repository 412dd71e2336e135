"""Controls map actions to motions of the robot."""

from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.control.close_loop import CloseLoop as CloseLoop, DeltaMove as DeltaMove
from bulletarm_gym.control.control import (
    Control as Control,
    GraspParams as GraspParams,
    Outcome as Outcome,
    RobotInterface as RobotInterface,
)
from bulletarm_gym.control.open_loop import Grasp as Grasp, OpenLoop as OpenLoop, PickPlace as PickPlace

CONTROLS: dict[str, type[Any]] = {CLOSE_LOOP: CloseLoop, OPEN_LOOP: OpenLoop}
