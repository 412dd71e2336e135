"""``bulletarm-zoo demos``: collects episodes of an expert."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bulletarm_gym.check.machine import load_average
from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, add_progress, positive_int, seed
from zoo_configs.cells.rules import task_name
from zoo_configs.environments import demonstrations, known_env_id, register_environments, try_env
from zoo_configs.errors import refused
from zoo_configs.files import check_writable
from zoo_configs.measuring.data_files import COLLECTING, DataFile, number
from zoo_configs.measuring.provenance import env_kwargs_words, key_values, provenance

DESCRIPTION = """Collect successful episodes of an expert into one HDF5 file, written when all are there.
Agents learn from it by: bulletarm-zoo train ... -params expert_data:"'FILE'"."""
SUFFIXES = (".h5", ".hdf5")


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if the planner cannot be used with the environment, or fails too often
    """
    args = _parse(argv)
    register_environments(args.gym_packages)
    env_id = known_env_id(args.env)
    path = args.output or Path(f"{env_id.rpartition('/')[2]}-{args.planner}.h5")
    check_writable(path, "--output")
    data = None if args.data is None else DataFile(args.data, COLLECTING)
    if data is not None:
        data.check("--data")
    try_env(env_id, args.env_kwargs)
    busy, begin = load_average(), time.perf_counter()
    with refused(f"{env_id}: no demonstrations", (RuntimeError, ValueError)):
        found = demonstrations().collect(
            env_id,
            args.episodes,
            args.planner,
            seed=args.seed,
            env_kwargs=args.env_kwargs,
            path=path,
            progress=args.progress,
        )
    rate = 60.0 * len(found) / (time.perf_counter() - begin)
    length = float(np.mean([len(episode) for episode in found]))
    if data is not None:
        data.add(_record(env_id, found.attempts, length, rate, busy, args))
    print(f"{env_id}: {len(found)} of {found.attempts} attempts succeeded, mean_length={length:.2f}")
    print(f"  {rate:.0f} episodes a minute")
    print(f"Written:\n  {path}")


def _record(
    env_id: str, attempts: int, length: float, rate: float, busy: float, args: argparse.Namespace
) -> dict[str, str]:
    """What is kept of the collection itself."""
    words = ["bulletarm-zoo", "demos", "--env", env_id, "-n", str(args.episodes), "--planner", args.planner]
    return {
        "env": task_name(env_id),
        "env_kwargs": " ".join(key_values(args.env_kwargs)),
        "planner": args.planner,
        "episodes": str(args.episodes),
        "seed": str(args.seed),
        "attempts": str(attempts),
        "mean_steps": number(length, 3),
        "episodes_per_minute": number(rate, 0),
        "load": number(busy, 1),
        **provenance([*words, "--seed", str(args.seed), *env_kwargs_words(args.env_kwargs)]),
    }


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo demos", description=DESCRIPTION)
    add = parser.add_argument
    add("--env", required=True, help="environment id, see bulletarm-zoo list")
    add("-n", "--episodes", type=positive_int, default=100, help="how many successful ones (default: 100)")
    add("--planner", default="waypoint", help="waypoint (default) or deconstruction")
    add("--seed", type=seed, default=0, help="seed of the collection (default: 0)")
    add_env_kwargs(parser)
    add_packages(parser)
    add("-o", "--output", type=Path, help="file to write (default: ENV-PLANNER.h5 in this folder)")
    add("--data", type=Path, metavar="FILE", help="CSV to put attempts, steps and rate into as a row")
    add_progress(parser)
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix not in SUFFIXES:
        parser.error(f"--output must end in {' or '.join(SUFFIXES)}, got {args.output}")
    return args
