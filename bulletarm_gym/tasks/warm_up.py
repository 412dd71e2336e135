"""Compilation of all numba functions when a process makes its first environment."""

from collections.abc import Callable
from contextlib import closing
from typing import Any

from bulletarm_gym.geometry.compilation import MONITOR

STEPS = 4
"""Number of the expert's steps in each episode: two picks and places."""
TASKS = "bulletarm_gym.tasks."
EPISODES: tuple[dict[str, Any], ...] = (
    {"task": "picking:BlockPicking", "control": "close_loop", "view": "point_cloud"},
    {
        "task": "pushing:BlockPushing",
        "control": "close_loop",
        "observation": ["heightmap", "color", "segmentation", "holding"],
    },
    {"task": "clutter:ObjectGrasping", "control": "close_loop", "object_set": ["cube"] * 5},
    {"task": "stacking:BlockStacking", "control": "open_loop"},
    {"task": "stacking:BlockStacking", "control": "open_loop", "surface": "ramp"},
)
"""Arguments of environments that together call every compiled function."""


class WarmUp:
    """Runs episodes if this process has compiled a function."""

    def __init__(self) -> None:
        self._is_running = False

    def run(self, make: Callable[..., Any]) -> None:
        """Run the episodes, unless they are running or all functions came from the cache.

        :param make: constructor of an environment
        """
        if self._is_running or not MONITOR.count:
            return
        self._is_running = True
        try:
            for parameters in EPISODES:
                _run(make(**{**parameters, "task": TASKS + parameters["task"], "obs_size": 32}))
        finally:
            self._is_running, MONITOR.count = False, 0


def _run(env: Any) -> None:
    with closing(env):
        env.reset(seed=0)
        for _ in range(STEPS):
            *_, terminated, truncated, _ = env.step(env.expert_action())
            if terminated or truncated:
                break


WARM_UP = WarmUp()
"""The warm-up of this process."""
