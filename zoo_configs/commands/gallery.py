"""``bulletarm-zoo gallery``: draws tasks at reset and solved, and a page of them."""

from __future__ import annotations

import argparse
import html
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from zoo_configs.arguments import (
    Parser,
    add_env_kwargs,
    add_packages,
    add_progress,
    hides_progress,
    positive_int,
    seed,
)
from zoo_configs.drawing.video import write_picture
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, whole_file

DESCRIPTION = """Draw each task twice, at reset and solved by its expert, from the front and above: one
picture a task, and index.html, a page that shows them all in as many columns as there is room for."""
PAGE = "index.html"
ATTEMPTS = 10  # episodes until the expert solves one
PICTURE_GAP = 4  # pixels between the two pictures
FIRST_SEED = 4  # with which the drawer faces the camera
HEAD = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>BulletArm Gym: tasks</title>
<style>
:root { color-scheme: light dark; font-family: system-ui, sans-serif; }
body { margin: 1rem; }
main { display: grid; gap: 1.25rem; grid-template-columns: repeat(auto-fill, minmax(min(100%, 20rem), 1fr)); }
figure { margin: 0; }
img { width: 100%; height: auto; border-radius: 6px; }
figcaption { overflow-wrap: anywhere; }
</style>
<h1>Tasks</h1>
<p>Each as an episode begins, and solved by its expert.</p>
<main>
"""

Picture = npt.NDArray[np.uint8]


class Drawn(NamedTuple):
    """
    A task and its picture.

    :param env_id: Its id
    :param path: The picture
    :param steps: That the expert took
    """

    env_id: str
    path: Path
    steps: int


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no such environment, or its expert solves none of ten episodes
    """
    from tqdm import tqdm

    args = _parse(argv)
    register_environments(args.gym_packages)
    env_ids = [known_env_id(env_id) for env_id in args.env] or our_env_ids()
    check_writable(args.output / PAGE, "--output")
    bar = tqdm(env_ids, unit="task", disable=hides_progress(args.progress))
    drawn = [_draw(env_id, args) for env_id in bar]
    with whole_file(args.output / PAGE) as partial:
        partial.write_text(_page(drawn), encoding="utf-8")
    print("\n".join(["Written:", *(f"  {task.path}" for task in drawn), f"  {args.output / PAGE}"]))


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo gallery", description=DESCRIPTION)
    add = parser.add_argument
    add("env", nargs="*", metavar="ENV", help="environment ids (default: all of ours)")
    add("-o", "--output", type=Path, default=Path("gallery"), help="folder to write (default: gallery)")
    add("--pixels", type=positive_int, default=320, help="side of each of the two pictures (default: 320)")
    add("--seed", type=seed, default=FIRST_SEED, help=f"seed of the scenes (default: {FIRST_SEED})")
    add_env_kwargs(parser)
    add_packages(parser)
    add_progress(parser)
    return parser.parse_args(argv)


def _draw(env_id: str, args: argparse.Namespace) -> Drawn:
    with closing(make_env(env_id, args.env_kwargs)) as env:
        for name in ("expert_action", "viewer"):
            if not hasattr(env.unwrapped, name):
                raise CommandError(f"{env_id} has no {name}: only our tasks and registered ones can be drawn")
        pictures, steps = _solve(env, env_id, args)
    path = args.output / f"{env_id.rpartition('/')[2]}.png"
    gap = np.full((args.pixels, PICTURE_GAP, 3), np.iinfo(np.uint8).max, np.uint8)
    write_picture(np.concatenate([pictures[0], gap, pictures[1]], axis=1), path)
    return Drawn(env_id, path, steps)


def _solve(
    env: gym.Env[Any, Any], env_id: str, args: argparse.Namespace
) -> tuple[tuple[Picture, Picture], int]:
    """Pictures of the first episode that the expert solves, and its length."""
    look, expert = (env.get_wrapper_attr(name) for name in ("viewer", "expert_action"))
    for episode in range(ATTEMPTS):
        env.reset(seed=args.seed + episode)
        before, steps, over = look.close_up(args.pixels), 0, False
        while not over:
            _, _, terminated, truncated, info = env.step(expert())
            steps, over = steps + 1, terminated or truncated
        if info["is_success"]:
            return (before, look.close_up(args.pixels)), steps
    raise CommandError(f"the expert of {env_id} solved none of {ATTEMPTS} episodes")


def _page(drawn: Sequence[Drawn]) -> str:
    return HEAD + "".join(map(_figure, drawn)) + "</main>\n</html>\n"


def _figure(task: Drawn) -> str:
    env_id, file = html.escape(task.env_id), html.escape(task.path.name)
    steps = "1 step" if task.steps == 1 else f"{task.steps} steps"
    return (
        f'<figure><a href="{file}"><img src="{file}" alt="{env_id} at reset and solved" loading="lazy"></a>\n'
        f"<figcaption><code>{env_id}</code>, {steps}</figcaption></figure>\n"
    )
