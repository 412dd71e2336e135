"""Progress of an episode from 0 to 1, the potential of the reward ``"progress"``."""

import math
from collections.abc import Callable
from itertools import islice, pairwise

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP
from bulletarm_gym.experts import CLOSED, Waypoint
from bulletarm_gym.experts.approach import Tracker, checked_plan, rotates
from bulletarm_gym.geometry import Pose, wrap_angle
from bulletarm_gym.observations import View
from bulletarm_gym.scene import Scene
from bulletarm_gym.scene.predicates import is_empty
from bulletarm_gym.tasks.task import Task

DISCOUNT = 0.99
"""Discount factor of the shaped reward (paper, Close-Loop 4D Benchmark)."""
DECAY = 5.0
"""Remaining path (closed-loop steps) of the expert at which its part of the progress is 1/e."""
MAX_WAYPOINTS = 20
"""Maximum number of waypoints that count as the remaining path."""


class Progress:
    """Progress of a task, from 0 to 1, a function of the state alone.

    It is the number of finished parts and the progress within the next part, relative to the number of parts.
    A part with a grasp has one half before and one after it. The progress within a half, or within a part
    without a grasp, decreases exponentially with the length of the expert's remaining path. Open-loop actions
    have no path.

    :param scene: scene of the task
    :param tracker: tracker of the task's plans
    :param make_rng: returns the generator of the expert's choices, in all steps of an episode the same
    """

    def __init__(
        self, task: Task, scene: Scene, tracker: Tracker, make_rng: Callable[[], np.random.Generator]
    ) -> None:
        self._task, self._scene, self._tracker, self._make_rng = task, scene, tracker, make_rng
        self._last: tuple[View | None, float] = (None, 0.0)

    def at(self, view: View) -> float:
        """Return the progress in the current state; nothing changes.

        :param view: view of the current state, for which the progress is computed once
        """
        if self._last[0] is not view:
            self._last = (view, self._compute())
        return self._last[1]

    def _compute(self) -> float:
        scene, rng = self._scene, self._make_rng()
        finished, parts = self._task.parts(scene, rng)
        share = 0.0 if is_empty(scene) else 0.5
        if scene.config.control == CLOSE_LOOP:
            path = self._tracker.path(checked_plan(self._task.plan(scene, rng)))
            share = _share(scene, list(islice(path, MAX_WAYPOINTS)))
        return min(1.0, (finished + share) / parts)


def _share(scene: Scene, plan: list[Waypoint]) -> float:
    """Return the progress within a part."""
    poses = [scene.robot.pose, *(waypoint.pose for waypoint in plan)]
    near = math.exp(-sum(_steps(scene, start, end) for start, end in pairwise(poses)) / DECAY)
    if _grasps(plan):
        return near / 2.0
    is_carried = not is_empty(scene) and plan[0].gripper == CLOSED
    return (1.0 + near) / 2.0 if is_carried else near


def _grasps(plan: list[Waypoint]) -> bool:
    """Return True if the gripper closes along a plan."""
    openings = [ratio for point in plan for ratio in (point.gripper, point.finish) if ratio is not None]
    return any(after < before for before, after in pairwise(openings))


def _steps(scene: Scene, start: Pose, end: Pose) -> float:
    """Return the length (closed-loop steps) of a path whose axes move at the same time."""
    distances = (abs(b - a) for a, b in zip(start.position, end.position, strict=True))
    rotation = abs(wrap_angle(end.yaw - start.yaw)) if rotates(scene) else 0.0
    return max(max(distances) / scene.max_translation, rotation / scene.max_rotation)
