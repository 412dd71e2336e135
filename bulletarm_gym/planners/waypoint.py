"""The waypoint planner (paper, Expert Demonstrations)."""

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.control import CloseLoop
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks import Task


def expert_action(
    task: Task, control: CloseLoop, scene: Scene, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return the action that brings the gripper towards the next waypoint of the task's plan.

    The plan is made anew from the present scene each time, so the expert recovers from what happened before.
    """
    waypoint = next(iter(task.plan(scene, rng)))
    return control.encode_action(control.towards(scene, waypoint))
