"""Compilation of all numba functions when a process makes its first environment."""

from collections.abc import Callable
from contextlib import closing
from typing import Any

from bulletarm_gym.geometry.compilation import MONITOR

SENSORS = ["heightmap", "color", "segmentation", "holding"]
EPISODES: list[dict[str, Any]] = [
    {"task": "picking:BlockPicking", "control": "close_loop", "view": "point_cloud"},
    {"task": "pushing:BlockPushing", "control": "close_loop", "observation": SENSORS},
    {"task": "clutter:ObjectGrasping", "control": "close_loop", "object_set": ["cube"] * 5},
    {"task": "stacking:BlockStacking", "control": "open_loop"},
    {"task": "stacking:BlockStacking", "control": "open_loop", "surface": "ramp"},
]
"""Arguments of environments that together call every compiled function."""


def warm_up(make: Callable[..., Any]) -> None:
    """Run one short episode of each environment, once, if this process has compiled a function.

    :param make: constructor of an environment
    """
    while MONITOR.count and EPISODES:
        parameters = EPISODES.pop()
        task = f"bulletarm_gym.tasks.{parameters['task']}"
        with closing(make(**{**parameters, "task": task, "obs_size": 32})) as env:
            env.reset(seed=0)
            for _ in range(4):  # two picks and places
                *_, terminated, truncated, _ = env.step(env.expert_action())
                if terminated or truncated:
                    break
