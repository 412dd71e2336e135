"""What is to be done: one file a family of tasks."""

from bulletarm_gym.tasks.task import CLOSED, HALF_OPEN, OPEN, Hints, Overlay, Task, Waypoint

__all__ = ["CLOSED", "HALF_OPEN", "OPEN", "Hints", "Overlay", "Task", "Waypoint"]
