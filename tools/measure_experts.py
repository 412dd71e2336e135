"""Measure the success rate and the mean episode length of the experts.

python tools/measure_experts.py -n 200 --data docs/data/experts.csv
python tools/measure_experts.py --snap --env-kwargs obs_size:64 --env BulletArm/OpenLoopBlockStacking-v0
python tools/measure_experts.py --planner deconstruction --env BulletArm/OpenLoopBlockStacking-v0

With --snap, the expert of an open-loop task acts on the pixel grid of spatial Q-learning. With --planner,
the program measures how many demonstrations a minute that planner collects (docs/data/collecting.csv).
"""

import argparse
import statistics
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bulletarm_gym.check.machine import load_average
from bulletarm_gym.demonstrations import collect
from measurements import Row, keep, number, provenance, show, words
from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.spatial_dqn.codec import DEFAULT_SEQUENCE, SpatialActionCodec, snap_to_grid
from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, positive_int, seed
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments
from zoo_configs.experiments.families import task_name

KEY = ("env", "robot", "env_kwargs", "snap")
COLLECTING_KEY = ("env", "env_kwargs", "planner")


def main() -> None:
    """Run the program."""
    args = parse()
    register_environments(args.gym_packages)
    env_ids = [known_env_id(name) for name in args.env] or our_env_ids()
    function, key = (measure_collecting, COLLECTING_KEY) if args.planner else (measure, KEY)
    show([keep(function(env_id, args), args.data, key) for env_id in tqdm(env_ids, unit="environment")])


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--env", nargs="+", default=[], help="environment ids (default: all of this package)")
    add("-n", "--episodes", type=positive_int, default=100, help="number of episodes (default: 100)")
    add("--seed", type=seed, default=0, help="seed of the first episode (default: 0)")
    add("--snap", action="store_true", help="round actions to the grid of spatial Q-learning")
    add("--planner", help="measure the collection of demonstrations: waypoint or deconstruction")
    add("--data", type=Path, metavar="FILE", help="CSV to add the measurements to")
    add_env_kwargs(parser)
    add_packages(parser)
    return parser.parse_args()


def measure(env_id: str, args: argparse.Namespace) -> Row:
    """Measure the expert of one environment."""
    with closing(make_env(env_id, args.env_kwargs)) as env:
        transform = grid_snapping(env) if args.snap else lambda action, _: action
        rng = np.random.default_rng(args.seed)
        lengths = [play(env, args.seed + episode, transform, rng) for episode in range(args.episodes)]
        robot = str(getattr(getattr(env.unwrapped, "config", None), "robot", ""))
    solved = [length for length in lengths if length is not None]
    others = {name: value for name, value in args.env_kwargs.items() if name != "robot"}
    return {
        "env": task_name(env_id),
        "robot": robot,
        "env_kwargs": words(others),
        "snap": "yes" if args.snap else "",
        "episodes": str(args.episodes),
        "first_seed": str(args.seed),
        "success": number(len(solved) / args.episodes, 4),
        "mean_steps": number(statistics.fmean(solved) if solved else float("nan"), 3),
        **provenance(),
    }


def measure_collecting(env_id: str, args: argparse.Namespace) -> Row:
    """Measure the collection of demonstrations in one environment."""
    load, begin = load_average(), time.perf_counter()
    found = collect(env_id, args.episodes, args.planner, seed=args.seed, env_kwargs=args.env_kwargs)
    rate = 60.0 * len(found) / (time.perf_counter() - begin)
    return {
        "env": task_name(env_id),
        "env_kwargs": words(args.env_kwargs),
        "planner": args.planner,
        "episodes": str(args.episodes),
        "seed": str(args.seed),
        "attempts": str(found.attempts),
        "mean_steps": number(statistics.fmean(map(len, found)), 3),
        "episodes_per_minute": number(rate, 0),
        "load": number(load, 1),
        **provenance(),
    }


def play(env: Any, seed: int, transform: Any, rng: np.random.Generator) -> int | None:
    """Play one episode and return its number of steps, None if the expert failed."""
    env.reset(seed=seed)
    steps, over = 0, False
    while not over:
        action = transform(env.get_wrapper_attr("expert_action")(), rng)
        _, _, terminated, truncated, info = env.step(action)
        steps, over = steps + 1, terminated or truncated
    return steps if info["is_success"] else None


def grid_snapping(env: Any) -> Any:
    """Return the transformation of actions to the grid over the heightmap."""
    sequence = getattr(getattr(env.unwrapped, "config", None), "action_sequence", DEFAULT_SEQUENCE)
    codec = SpatialActionCodec(SceneView(env.observation_space).size, sequence)
    return partial(snap_to_grid, space=env.action_space, codec=codec)


if __name__ == "__main__":
    main()
