"""Tasks, one module per family."""

from bulletarm_gym.control import GraspParams as GraspParams
from bulletarm_gym.experts import CLOSED as CLOSED, HALF_OPEN as HALF_OPEN, OPEN as OPEN, Waypoint as Waypoint
from bulletarm_gym.observations import Overlay as Overlay
from bulletarm_gym.tasks.task import Task as Task
