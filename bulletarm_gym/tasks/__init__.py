"""What is to be done: one file a family of tasks."""

from bulletarm_gym.tasks.task import CLOSED, OPEN, Task, Waypoint

__all__ = ["CLOSED", "OPEN", "Task", "Waypoint"]
