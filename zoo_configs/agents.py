"""Trained agents: finding them on disk and loading them."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_extensions.common.env_metadata import constructor_keys
from zoo_configs.algorithms import ALGORITHMS, algorithm_classes
from zoo_configs.environments import known_env_id, register_environments
from zoo_configs.errors import CommandError, refused
from zoo_configs.publishing.published import Published, find_published
from zoo_configs.training.runs import Run, find_runs, load_run

# Schedules are of no use to a model that is not trained, and need not be loadable.
UNUSED_OBJECTS: dict[str, Any] = {
    "learning_rate": 0.0,
    "lr_schedule": lambda _: 0.0,
    "clip_range": lambda _: 0.0,
}


@dataclass(frozen=True)
class Agent:
    """
    A trained agent and where it comes from.

    :param model: The agent
    :param path: Its file
    :param label: Its baseline, or algorithm
    :param env_id: Id of the environment that it was trained on
    :param env_kwargs: Parameters of that environment
    :param run: Its run; None for one that is published
    """

    model: BaseAlgorithm
    path: Path
    label: str
    env_id: str
    env_kwargs: dict[str, Any]
    run: Run | None = None

    @property
    def folder(self) -> Path:
        """Where films of it go by default."""
        return Path() if self.run is None else self.run.folder

    def check_plain(self, what: str) -> None:
        """
        Ask whether it acts on observations as the environment gives them.

        :param what: What cannot be done if not
        :raises CommandError: if they are normalised, stacked or wrapped
        """
        hyperparams = {} if self.run is None else self.run.cell.hyperparams
        if any(hyperparams.get(key) for key in ("normalize", "frame_stack", "vec_env_wrapper")):
            raise CommandError(f"{self.path} acts on normalised or stacked observations, {what}")


def agent_from_arguments(args: argparse.Namespace) -> Agent:
    """
    Load the agent that the flags of :func:`zoo_configs.arguments.add_run_arguments` name, a run's or, with
    :func:`zoo_configs.arguments.add_published`, a published one.

    :param args: The parsed flags
    :return: The agent
    :raises CommandError: if there is none
    """
    if getattr(args, "published", None) is not None:
        return _published_agent(args)
    return agent_of(run_from_arguments(args), args.load_best, args.device)


def agent_of(run: Run, best: bool, device: str) -> Agent:
    """
    Load the agent of a run.

    :param run: The run
    :param best: Whether to prefer the model that did best in a periodic evaluation
    :param device: PyTorch device
    :return: The agent
    :raises CommandError: if the run has saved no model yet, or the file is damaged
    """
    model, path = load_agent(run, best, device)
    env_kwargs = dict(run.cell.hyperparams.get("env_kwargs", {}))
    env_kwargs.pop("render_mode", None)
    return Agent(model, path, run.cell.label, run.cell.env_id, env_kwargs, run)


def _published_agent(args: argparse.Namespace) -> Agent:
    if args.run is not None or args.env is not None:
        raise CommandError("--published names an agent by itself: give neither a run folder nor --env")
    register_environments(args.gym_packages)
    found = find_published(args.published, args.baseline)
    register_environments(found.card.gym_packages)
    known_env_id(found.card.env)
    model = load_published(found, args.device)
    return Agent(model, found.model_file, found.card.label, found.card.env, dict(found.card.env_kwargs))


def load_published(found: Published, device: str = "auto") -> BaseAlgorithm:
    """
    Load a published agent.

    :param found: The agent
    :param device: PyTorch device
    :return: The model; what of it does not act is NaN
    :raises CommandError: if its file is damaged
    """
    with refused(f"{found.model_file} is damaged, or of another version"):
        model: BaseAlgorithm = algorithm_classes()[found.card.algo].load(found.model_file, device=device)
    return model


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
        if args.algo in (None, run.cell.algo, run.cell.baseline)
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
    algorithm = algorithm_classes()[run.cell.algo]
    # An agent that only acts needs no memory; our buffers allocate none before their first transition.
    takes_buffer = run.cell.algo not in ALGORITHMS and "buffer_size" in constructor_keys(algorithm)
    buffer = {"buffer_size": 1} if takes_buffer else {}
    with refused(f"{path} is damaged, or of another version"):
        model: BaseAlgorithm = algorithm.load(path, device=device, custom_objects=UNUSED_OBJECTS, **buffer)
    return model, path
