"""The waypoint planner (paper, Expert Demonstrations)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.control import Control
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks import Task


def expert_action(
    task: Task, control: Control[Any], scene: Scene, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return the next action of the task's plan.

    The plan is made anew from the present scene each time, so the expert recovers from what happened before.
    """
    return control.encode_action(control.next_move(scene, iter(task.plan(scene, rng))))
