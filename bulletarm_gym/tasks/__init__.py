"""Tasks, one module per family."""

from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts import CLOSED, HALF_OPEN, OPEN, Waypoint
from bulletarm_gym.observations import Overlay
from bulletarm_gym.tasks.task import Task

__all__ = ["CLOSED", "HALF_OPEN", "OPEN", "GraspParams", "Overlay", "Task", "Waypoint"]
