"""Draw tasks on one sheet, at reset and solved: ``python examples/draw_tasks.py [--heightmap]``."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

from bulletarm_gym.env import ManipulationEnv

SOME = [
    f"BulletArm/{name}-v0"
    for name in (
        "OpenLoopHouseBuilding4",
        "OpenLoopBinPacking",
        "OpenLoopBottleArrangement",
        "OpenLoopCovidTest",
        "OpenLoopRampImproviseHouseBuilding3",
        "OpenLoopBumpBoxPalletizing",
        "CloseLoopDrawerOpening",
        "CloseLoopObjectGrasping",
    )
]
TASKS_A_ROW = 4
PIXELS = 240
"""Side length of an image."""
SEEDS = range(4, 14)
"""Tried in this order: with the first of them the drawer faces the camera."""

Image = np.ndarray
Draw = Callable[[ManipulationEnv, dict[str, Image]], Image]


def main() -> None:
    """Solve every task with its expert and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--heightmap", action="store_true", help="draw the heightmap instead of the scene")
    parser.add_argument("--env", nargs="+", default=SOME, help="the tasks, by id (default: eight of them)")
    parser.add_argument("--output", type=Path, default=Path("docs/images/some_tasks.png"))
    arguments = parser.parse_args()
    sheet(arguments.env, heightmap if arguments.heightmap else scene, arguments.output)
    print(f"wrote {arguments.output}")


def sheet(env_ids: Sequence[str], draw: Draw, output: Path) -> None:
    """Write two images of each task: at reset and at success."""
    rows = -(-len(env_ids) // TASKS_A_ROW)
    size = (TASKS_A_ROW * 2 * PIXELS / 100.0, rows * (PIXELS + 24) / 100.0)
    figure = plt.figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    panels = figure.subfigures(rows, TASKS_A_ROW, squeeze=False)
    for panel, env_id in zip(panels.flat, env_ids, strict=False):
        panel.suptitle(env_id.removeprefix("BulletArm/").removesuffix("-v0"), y=0.0, va="bottom", fontsize=11)
        for axis, image in zip(panel.subplots(1, 2), solve(env_id, draw), strict=True):
            axis.imshow(image, interpolation="nearest")
            axis.axis("off")
    figure.savefig(output, dpi=100)


def solve(env_id: str, draw: Draw) -> tuple[Image, Image]:
    """Return images of a task at reset and at success, with the first seed that its expert solves."""
    env = gymnasium.make(env_id)
    for seed in SEEDS:
        observation, info = env.reset(seed=seed)
        before, done = draw(env.unwrapped, observation), False
        while not done:
            observation, _, terminated, truncated, info = env.step(env.unwrapped.expert_action())
            done = terminated or truncated
        if info["is_success"]:
            break
    after = draw(env.unwrapped, observation)
    env.close()
    return before, after


def scene(env: ManipulationEnv, _: dict[str, Image]) -> Image:
    """Return an image of the workspace from the front and above."""
    return env.viewer.close_up(PIXELS)


def heightmap(_: ManipulationEnv, observation: dict[str, Image]) -> Image:
    """Return the heightmap of an observation, (rows, columns) in m."""
    return observation["heightmap"][0]


if __name__ == "__main__":
    main()
