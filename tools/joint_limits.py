"""Share of the expert's steps that end outside the published joint limits, and the smallest distance to one.

python tools/joint_limits.py --robot kuka panda --episodes 10
"""

import argparse
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
from tqdm import tqdm

import bulletarm_gym


def margins(env: Any, episodes: int) -> Iterator[float]:
    """Yield the distance (rad) to the nearest joint limit after each step of the expert."""
    robot = env.scene.robot
    lower, upper = robot.model.chain.limits.T
    for seed in range(episodes):
        env.reset(seed=seed)
        is_over = False
        while not is_over:
            _, _, terminated, truncated, _ = env.step(env.expert_action())
            is_over = terminated or truncated
            joints = np.array(robot.joint_positions)
            yield float(np.minimum(joints - lower, upper - joints).min())


def group(env_id: str) -> str:
    """Return the row of the table that an environment belongs to."""
    control = "closed loop" if "CloseLoop" in env_id else "open loop"
    return f"{control}, {'ramps and bumps' if 'Ramp' in env_id or 'Bump' in env_id else 'level surfaces'}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robot", nargs="+", default=["kuka", "panda"], metavar="NAME")
    parser.add_argument("--episodes", type=int, default=10, metavar="N")
    args = parser.parse_args()
    print("| arm | environments | ids | steps | outside the limits | least distance (rad) |")
    print("|---|---|---:|---:|---:|---:|")
    for robot in args.robot:
        found: dict[str, list[np.ndarray]] = {}
        for env_id in tqdm(bulletarm_gym.ENV_IDS, desc=robot, leave=False):
            with closing(gymnasium.make(env_id, robot=robot).unwrapped) as env:
                found.setdefault(group(env_id), []).append(np.array([*margins(env, args.episodes)]))
        for name, parts in found.items():
            steps = np.concatenate(parts)
            figures = f"{len(steps):,}", f"{(steps < 0).mean():.1%}", f"{steps.min():.3f}"
            print("| " + " | ".join((robot, name, str(len(parts)), *figures)) + " |", flush=True)


if __name__ == "__main__":
    main()
