"""Simulated duration (s) of single motions in closed loop, and of the expert's actions.

python tools/action_durations.py --episodes 10
"""

import argparse
import itertools
from collections.abc import Callable
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np

import bulletarm_gym  # noqa: F401 (registers the ids)
from bulletarm_gym.simulation.world import TIME_STEP

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
DOWN = (1.0, 0.0, 0.0, -1.0, 0.0)
MOTIONS = {
    "5 cm in free space": [(1.0, 1.0, 0.0, 0.0, 0.0)],
    "1 cm in free space": [(1.0, 0.2, 0.0, 0.0, 0.0)],
    "rotation by 45 degrees": [(1.0, 0.0, 0.0, 0.0, 1.0)],
    "closing the open gripper": [(-1.0, 0.0, 0.0, 0.0, 0.0)],
    "5 cm, pushing a cube": [DOWN, DOWN, DOWN, DOWN, (1.0, 1.0, 0.0, 0.0, 0.0)],
}
"""Actions from the home pose; the last one is measured."""
TASKS = ("CloseLoopBlockPicking", "CloseLoopBlockPushing", "OpenLoopBlockStacking")


class Clock:
    """Clock of the simulated time of an environment."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._count = 0
        env.scene.world.wrap_step(self._counted)

    def _counted(self, step: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            self._count += 1
            return step(*args, **options)

        return call

    def step(self, action: Any) -> tuple[float, bool]:
        """Execute an action; return its duration (s) and whether the episode has ended."""
        before = self._count
        _, _, terminated, truncated, _ = self._env.step(action)
        return (self._count - before) * TIME_STEP, terminated or truncated


def expert_durations(env: Any, episodes: int) -> list[float]:
    """Return the duration (s) of each step of the expert."""
    clock, found = Clock(env), []
    for seed in range(episodes):
        env.reset(seed=seed)
        is_over = False
        while not is_over:
            duration, is_over = clock.step(env.expert_action())
            found.append(duration)
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10, metavar="N")
    args = parser.parse_args()
    print("| motion | simulated time |\n|---|---:|")
    with closing(gymnasium.make(PICKING, fast_mode=False).unwrapped) as env:
        clock = Clock(env)
        for motion, actions in MOTIONS.items():
            env.reset(seed=1)
            durations = [clock.step(action)[0] for action in actions]
            print(f"| {motion} | {durations[-1]:.2f} s |")
    heads = "task | `physics_mode` | `fast_mode` | minimum | median | maximum"
    print(f"\n| {heads} |\n|---|---|---|---:|---:|---:|")
    for task, physics_mode, fast_mode in itertools.product(TASKS, ("fast", "slow"), (True, False)):
        parameters = {"physics_mode": physics_mode, "fast_mode": fast_mode}
        with closing(gymnasium.make(f"BulletArm/{task}-v0", **parameters).unwrapped) as env:
            found = expert_durations(env, args.episodes)
        figures = " | ".join(f"{value:.2f}" for value in (min(found), np.median(found), max(found)))
        print(f"| `{task}` | `{physics_mode}` | `{fast_mode}` | {figures} |")


if __name__ == "__main__":
    main()
