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
from zoo_configs.drawing.video import draw_image, write_picture
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, whole_file

DESCRIPTION = """Draw each task twice, at reset and solved by its expert, from the front and above: one
picture a task, and index.html, a page that shows them all in as many columns as there is room for."""
PAGE = "index.html"
FORMATS = ("png", "webp")
HEIGHTMAP = "heightmap"  # name of the image in an observation, and of its picture
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
    :param paths: The picture, and that of the heightmap where it was asked for
    :param steps: That the expert took
    """

    env_id: str
    paths: list[Path]
    steps: int


class Look(NamedTuple):
    """
    A task at one moment.

    :param scene: The picture of it, shape (pixels, pixels, 3)
    :param observation: What the agent sees
    """

    scene: Picture
    observation: Any


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
    paths = [*(path for task in drawn for path in task.paths), args.output / PAGE]
    print("\n".join(["Written:", *(f"  {path}" for path in paths)]))


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo gallery", description=DESCRIPTION)
    add = parser.add_argument
    add("env", nargs="*", metavar="ENV", help="environment ids (default: all of ours)")
    add("-o", "--output", type=Path, default=Path("gallery"), help="folder to write (default: gallery)")
    add("--pixels", type=positive_int, default=320, help="side of each of the two pictures (default: 320)")
    add("--heightmap", action="store_true", help="draw the heightmap that the agent sees, too")
    add("--format", choices=FORMATS, default=FORMATS[0], help=f"of the pictures (default: {FORMATS[0]})")
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
        looks, steps = _solve(env, env_id, args)
    rows = {"": [look.scene for look in looks]}
    if args.heightmap:
        rows[f"-{HEIGHTMAP}"] = _heightmaps(env_id, looks, args.pixels)
    name = env_id.rpartition("/")[2]
    paths = [args.output / f"{name}{suffix}.{args.format}" for suffix in rows]
    for path, pictures in zip(paths, rows.values(), strict=True):
        write_picture(_side_by_side(pictures), path)
    return Drawn(env_id, paths, steps)


def _side_by_side(pictures: Sequence[Picture]) -> Picture:
    before, after = pictures
    gap = np.full((len(before), PICTURE_GAP, 3), np.iinfo(np.uint8).max, np.uint8)
    return np.concatenate([before, gap, after], axis=1)


def _heightmaps(env_id: str, looks: Sequence[Look], pixels: int) -> list[Picture]:
    """Pictures whose colours span what there is in both of them."""
    if any(HEIGHTMAP not in look.observation for look in looks):
        raise CommandError(f"--heightmap: {env_id} shows {', '.join(looks[0].observation)}")
    images = [look.observation[HEIGHTMAP][0] for look in looks]
    low, high = min(map(np.min, images)), max(map(np.max, images))
    return [draw_image(image, (low, high), pixels) for image in images]


def _solve(env: gym.Env[Any, Any], env_id: str, args: argparse.Namespace) -> tuple[tuple[Look, Look], int]:
    """The beginning and the end of the first episode that the expert solves, and its length."""
    eye, expert = (env.get_wrapper_attr(name) for name in ("viewer", "expert_action"))
    for episode in range(ATTEMPTS):
        observation, info = env.reset(seed=args.seed + episode)
        before, steps, over = Look(eye.close_up(args.pixels), observation), 0, False
        while not over:
            observation, _, terminated, truncated, info = env.step(expert())
            steps, over = steps + 1, terminated or truncated
        if info["is_success"]:
            return (before, Look(eye.close_up(args.pixels), observation)), steps
    raise CommandError(f"the expert of {env_id} solved none of {ATTEMPTS} episodes")


def _page(drawn: Sequence[Drawn]) -> str:
    return HEAD + "".join(map(_figure, drawn)) + "</main>\n</html>\n"


def _figure(task: Drawn) -> str:
    env_id = html.escape(task.env_id)
    steps = "1 step" if task.steps == 1 else f"{task.steps} steps"
    pictures = "\n".join(_picture(env_id, html.escape(path.name)) for path in task.paths)
    return f"<figure>{pictures}\n<figcaption><code>{env_id}</code>, {steps}</figcaption></figure>\n"


def _picture(env_id: str, file: str) -> str:
    alt = f"{env_id} at reset and solved"
    return f'<a href="{file}"><img src="{file}" alt="{alt}" loading="lazy"></a>'
