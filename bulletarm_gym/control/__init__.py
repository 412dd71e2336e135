"""How the arm is commanded."""

from collections.abc import Callable
from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig
from bulletarm_gym.control.close_loop import CloseLoop, DeltaMove
from bulletarm_gym.control.control import Control, Outcome
from bulletarm_gym.control.open_loop import OpenLoop, PickPlace
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks import Task

CONTROLS: dict[str, Callable[[EnvConfig, Scene, Task], Control[Any]]] = {
    CLOSE_LOOP: CloseLoop,
    OPEN_LOOP: OpenLoop,
}

__all__ = ["CONTROLS", "CloseLoop", "Control", "DeltaMove", "OpenLoop", "Outcome", "PickPlace"]
