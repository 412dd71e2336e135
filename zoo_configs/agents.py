"""Trained agents: finding them on disk and loading them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from zoo_configs.algorithms import ALGORITHMS, register_algorithms
from zoo_configs.cells.validation import constructor_keys
from zoo_configs.environments import known_env_id, register_environments
from zoo_configs.errors import CommandError, refused
from zoo_configs.training.runs import Run, find_runs, load_run

# Schedules are of no use to a model that is not trained, and need not be loadable.
UNUSED_OBJECTS: dict[str, Any] = {
    "learning_rate": 0.0,
    "lr_schedule": lambda _: 0.0,
    "clip_range": lambda _: 0.0,
}


def run_from_arguments(args: argparse.Namespace) -> Run:
    """
    Find the run that the flags of :func:`zoo_configs.arguments.add_run_arguments` name, and register what it
    was trained on.

    :param args: The parsed flags
    :return: The run
    :raises CommandError: if there is none
    """
    run = load_run(args.run) if args.run is not None else _newest_run(args)
    register_environments(run.gym_packages)
    known_env_id(run.cell.env_id)
    return run


def _newest_run(args: argparse.Namespace) -> Run:
    """The newest one that has a model, among those that are named."""
    if args.env is None or (args.baseline is None and args.algo is None):
        raise CommandError("name a run folder, or --env with --baseline or --algo")
    env_id = args.env.rpartition(":")[2]
    of_env = find_runs(args.log_folder, env_id)
    if not of_env:
        known_env_id(args.env)  # a name that does not exist is the nearer reason
    runs = [
        run
        for run in of_env
        if args.algo in (None, run.cell.algo)
        and args.baseline in (None, run.cell.baseline)
        and args.preset in (None, run.cell.preset)
        and args.exp_id in (0, run.number)
    ]
    if not runs:
        raise CommandError(f"{args.log_folder} has no such run of {args.baseline or args.algo} on {env_id}")
    return next((run for run in reversed(runs) if run.has_model), runs[-1])


def load_agent(run: Run, best: bool, device: str) -> tuple[BaseAlgorithm, Path]:
    """
    Load the model of a run.

    :param run: The run
    :param best: Whether to prefer the model that did best in a periodic evaluation
    :param device: PyTorch device
    :return: The model, and the file it comes from
    :raises CommandError: if the run has saved no model yet, or the file is damaged
    """
    path = run.best_model if best and run.best_model.is_file() else run.last_model
    if not path.is_file():
        raise CommandError(f"{run.folder} has no model yet")
    algorithm = register_algorithms()[run.cell.algo]
    # An agent that only acts needs no memory; our buffers allocate none before their first transition.
    takes_buffer = run.cell.algo not in ALGORITHMS and "buffer_size" in constructor_keys(algorithm)
    buffer = {"buffer_size": 1} if takes_buffer else {}
    with refused(f"{path} is damaged, or of another version"):
        model: BaseAlgorithm = algorithm.load(path, device=device, custom_objects=UNUSED_OBJECTS, **buffer)
    return model, path
