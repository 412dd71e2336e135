"""Draw the tasks at reset and solved by the expert, as in docs/images/tasks.

python tools/draw_gallery.py -o docs/images/tasks --pixels 480 --heightmap
"""

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from PIL import Image
from tqdm import tqdm

from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, positive_int, seed
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments

HEIGHTMAP = "heightmap"
"""Observation that ``--heightmap`` draws."""
ATTEMPTS = 10
"""Number of episodes until the expert must have solved one."""
GAP = 4
"""Width (pixels) of the gap between the two images."""
FIRST_SEED = 4
"""Default seed, with which the drawer faces the camera."""


def main() -> None:
    """Run the program."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--env", nargs="+", default=[], help="environment ids (default: all of this package)")
    add("-o", "--output", type=Path, default=Path("gallery"), help="output folder (default: gallery)")
    add("--pixels", type=positive_int, default=320, help="side of each image (default: 320)")
    add("--heightmap", action="store_true", help="draw the observed heightmap as well")
    add("--seed", type=seed, default=FIRST_SEED, help=f"seed of the scenes (default: {FIRST_SEED})")
    add_env_kwargs(parser)
    add_packages(parser)
    args = parser.parse_args()
    register_environments(args.gym_packages)
    env_ids = [known_env_id(name) for name in args.env] or our_env_ids()
    for env_id in tqdm(env_ids, unit="environment"):
        draw(env_id, args)


def draw(env_id: str, args: argparse.Namespace) -> None:
    """Draw one task."""
    with closing(make_env(env_id, args.env_kwargs)) as env:
        views = solve(env, args.seed, args.pixels)
    images = {"": [scene for scene, _ in views]}
    if args.heightmap:
        images[f"-{HEIGHTMAP}"] = heightmaps([observation for _, observation in views], args.pixels)
    for suffix, pair in images.items():
        gap = np.full((args.pixels, GAP, 3), 255, np.uint8)
        path = args.output / f"{env_id.rpartition('/')[2]}{suffix}.webp"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.concatenate([pair[0], gap, pair[1]], axis=1)).save(path)


def solve(env: Any, seed: int, pixels: int) -> list[tuple[Any, Any]]:
    """Return image and observation at reset and at the end of the first episode that the expert solves."""
    viewer, expert = (env.get_wrapper_attr(name) for name in ("viewer", "expert_action"))
    for attempt in range(ATTEMPTS):
        observation, info = env.reset(seed=seed + attempt)
        before, over = (viewer.close_up(pixels), observation), False
        while not over:
            observation, _, terminated, truncated, info = env.step(expert())
            over = terminated or truncated
        if info["is_success"]:
            return [before, (viewer.close_up(pixels), observation)]
    raise RuntimeError(f"the expert solved none of {ATTEMPTS} episodes of {env.spec.id}")


def heightmaps(observations: list[Any], pixels: int) -> list[Any]:
    """Return images of two heightmaps with the same colour scale."""
    images = np.array([observation[HEIGHTMAP][0] for observation in observations])
    colours = colormaps["viridis"]((images - images.min()) / np.ptp(images), bytes=True)[..., :3]
    resized = [Image.fromarray(image).resize((pixels, pixels), Image.Resampling.NEAREST) for image in colours]
    return [np.asarray(image) for image in resized]


if __name__ == "__main__":
    main()
