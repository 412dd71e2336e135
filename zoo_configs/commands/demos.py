"""``bulletarm-zoo demos``: collects demonstrations of an expert."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, add_progress, positive_int, seed
from zoo_configs.environments import known_env_id, register_environments, try_env
from zoo_configs.errors import refused
from zoo_configs.files import check_writable, print_written

DESCRIPTION = """Collect successful episodes of an expert into one HDF5 file, which is written at the end.
To train with it: bulletarm-zoo train ... -params expert_data:FILE."""
SUFFIXES = (".h5", ".hdf5")


def main(argv: Sequence[str]) -> None:
    """Run the command."""
    args = _parse(argv)
    from bulletarm_gym.demonstrations import collect

    register_environments(args.gym_packages)
    env_id = known_env_id(args.env)
    path = args.output or Path(f"{env_id.rpartition('/')[2]}-{args.planner}.h5")
    check_writable(path, "--output")
    try_env(env_id, args.env_kwargs)
    settings = {"seed": args.seed, "env_kwargs": args.env_kwargs, "path": path, "progress": args.progress}
    with refused(f"{env_id}: no demonstrations", (RuntimeError, ValueError)):
        found = collect(env_id, args.episodes, args.planner, **settings)
    length = fmean(len(episode) for episode in found)
    print(f"{env_id}: {len(found)} of {found.attempts} attempts succeeded, mean_length={length:.2f}")
    print_written(path)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo demos", description=DESCRIPTION)
    add = parser.add_argument
    add("--env", required=True, help="environment id, see bulletarm-zoo list")
    add("-n", "--episodes", type=positive_int, default=100, help="successful episodes (default: 100)")
    add("--planner", default="waypoint", help="waypoint (default) or deconstruction")
    add("--seed", type=seed, default=0, help="seed of the collection (default: 0)")
    add("-o", "--output", type=Path, help="file to write (default: ENV-PLANNER.h5)")
    add_env_kwargs(parser)
    add_packages(parser)
    add_progress(parser)
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix not in SUFFIXES:
        parser.error(f"--output must end in {' or '.join(SUFFIXES)}, got {args.output}")
    return args
