"""Draw the tasks at reset and solved by the expert, as in docs/images/tasks.

python tools/draw_gallery.py -o docs/images/tasks --pixels 560 --heightmap
"""

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, positive_int, seed
from zoo_configs.drawing.video import colour, observed_images
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments

HEIGHTMAP = "heightmap"
"""Observation that ``--heightmap`` draws."""
ATTEMPTS = 10
"""Number of episodes until the expert must have solved one."""
GAP = 4
"""Width (pixels) of the gap between the two images."""
CROP = (0.16, 0.0, 0.92, 0.95)
"""Left, top, right and bottom of the drawn part of an image, relative to its side."""
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
    kwargs = {"render_mode": "rgb_array", "render_size": [args.pixels, args.pixels], **args.env_kwargs}
    with closing(make_env(env_id, kwargs)) as env:
        views = solve(env, args.seed)
    left, top, right, bottom = (round(share * args.pixels) for share in CROP)
    pairs = {"": [scene[top:bottom, left:right] for scene, _ in views]}
    if args.heightmap:
        size, nearest = (args.pixels, args.pixels), Image.Resampling.NEAREST
        pairs[f"-{HEIGHTMAP}"] = [np.asarray(Image.fromarray(one).resize(size, nearest)) for _, one in views]
    for suffix, (before, after) in pairs.items():
        gap = np.full((len(before), GAP, 3), 255, np.uint8)
        path = args.output / f"{env_id.rpartition('/')[2]}{suffix}.webp"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.concatenate([before, gap, after], axis=1)).save(path)


def solve(env: Any, seed: int) -> list[tuple[Any, Any]]:
    """Return scene and heightmap at reset and at the end of the first episode that the expert solves."""
    for attempt in range(ATTEMPTS):
        observation, info = env.reset(seed=seed + attempt)
        before, over = (env.render(), heights(observation, env)), False
        while not over:
            observation, _, terminated, truncated, info = env.step(env.unwrapped.expert_action())
            over = terminated or truncated
        if info["is_success"]:
            return [before, (env.render(), heights(observation, env))]
    raise RuntimeError(f"the expert solved none of {ATTEMPTS} episodes of {env.spec.id}")


def heights(observation: Any, env: Any) -> Any:
    """Return the drawing of the heightmap."""
    return colour(next(observed_images(observation, env)))


if __name__ == "__main__":
    main()
