"""Trained agents: finding and loading them."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_extensions.common.env_metadata import constructor_arguments
from zoo_configs.algorithms import ALGORITHMS, algorithm_classes
from zoo_configs.arguments import check_device
from zoo_configs.cards import Card, find_published
from zoo_configs.environments import known_env_id, register_environments
from zoo_configs.errors import CommandError, check_names, refused
from zoo_configs.training.runs import RESOLVED_FILE, Run, find_runs, load_run

UNUSED_OBJECTS: dict[str, Any] = {
    "learning_rate": 0.0,
    "lr_schedule": lambda _: 0.0,
    "clip_range": lambda _: 0.0,
}
"""Schedules that an agent does not need for acting, so that they need not be loadable."""


@dataclass(frozen=True)
class Agent:
    """
    Trained agent and its origin.

    :param label: Baseline, algorithm or name of the file
    :param run: Run of the agent; None for a published agent or a file without a run
    """

    model: BaseAlgorithm
    path: Path
    label: str
    env_id: str
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    run: Run | None = None

    @property
    def hyperparams(self) -> dict[str, Any]:
        """Hyperparameters of the run, an empty dictionary without one."""
        return {} if self.run is None else self.run.experiment.hyperparams


@dataclass(frozen=True)
class AgentQuery:
    """
    Description of an agent to load: a path, or the newest run with some properties.

    :param path: Run folder, or a model file that ``save()`` wrote
    :param algo: Algorithm, or the baseline of this name
    :param log_folder: Folder of all runs
    :param load_best: Whether to load the best model instead of the last one
    :param published: Task or folder of a published agent
    :param gym_packages: Packages that register environments
    """

    path: Path | None = None
    env: str | None = None
    baseline: str | None = None
    algo: str | None = None
    preset: str | None = None
    log_folder: Path = Path("logs")
    load_best: bool = True
    device: str = "auto"
    published: str | None = None
    gym_packages: Sequence[str] = ()


def query_of(args: argparse.Namespace) -> AgentQuery:
    """Return the query that the flags of an agent describe."""
    names = {item.name for item in fields(AgentQuery)}
    return AgentQuery(**{name: value for name, value in vars(args).items() if name in names})


def find_agent(query: AgentQuery) -> Agent:
    """Find and load the agent that a query describes; raise ``CommandError`` if there is none."""
    check_device(query.device)
    register_environments(query.gym_packages)
    if query.published is not None:
        return _published_agent(query)
    if query.path is not None and query.path.suffix == ".zip":
        _check_unused(query, "a model file", "baseline", "preset", "load_best")
        return _agent_of_file(query.path, query)
    return agent_of(find_run(query), query.load_best, query.device)


def find_run(query: AgentQuery) -> Run:
    """Find the run that a query describes and register its environment."""
    if query.path is not None:
        _check_unused(query, "a run folder", "env", "baseline", "algo", "preset")
    run = load_run(query.path) if query.path is not None else _newest_run(query)
    register_run(run)
    return run


def _check_unused(query: AgentQuery, source: str, *names: str) -> None:
    """Raise ``CommandError`` if a query has properties that cannot select an agent of its source."""
    changed = [name for name in names if getattr(query, name) != getattr(AgentQuery, name)]
    if flags := [f"--{name}".replace("load_best", "load-last") for name in changed]:
        raise CommandError(f"{', '.join(flags)} cannot be combined with {source}")


def register_run(run: Run) -> None:
    """Register the environment of a run."""
    register_environments(run.gym_packages)
    known_env_id(run.experiment.env_id)


def _newest_run(query: AgentQuery) -> Run:
    """Return the newest fitting run with a model, else the newest fitting run."""
    if query.env is None or (query.baseline is None and query.algo is None):
        raise CommandError("pass a run folder, a model file, or --env with --baseline or --algo")
    env_id = query.env.rpartition(":")[2]
    of_env = find_runs(query.log_folder, env_id)
    if not of_env:
        known_env_id(query.env)  # an unknown id explains the missing run
    runs = [
        run
        for run in of_env
        if query.algo in (None, run.experiment.algo, run.experiment.baseline)
        and query.baseline in (None, run.experiment.baseline)
        and query.preset in (None, run.experiment.preset)
    ]
    if not runs:
        wanted = " ".join(filter(None, [query.baseline or query.algo, query.preset]))
        must = f"a folder with runs of {wanted} on {env_id}"
        raise CommandError(f"--log-folder must be {must}, got {query.log_folder}")
    return next((run for run in reversed(runs) if run.has_model), runs[-1])


def agent_of(run: Run, best: bool = True, device: str = "auto") -> Agent:
    """Load the best or the last model of a run; a run without evaluations has only the last one."""
    path = run.best_model if best and run.best_model.is_file() else run.last_model
    if not path.is_file():
        raise CommandError(f"{run.folder} has no model yet")
    return _agent_of_run(run, path, device)


def _agent_of_run(run: Run, path: Path, device: str) -> Agent:
    env_kwargs = dict(run.experiment.hyperparams.get("env_kwargs", {}))
    env_kwargs.pop("render_mode", None)
    model = load_model(path, run.experiment.algo, device)
    return Agent(model, path, run.experiment.label, run.experiment.env_id, env_kwargs, run)


def _agent_of_file(path: Path, query: AgentQuery) -> Agent:
    """Load a model file, with the environment of its run or another one of ``--env``."""
    if (path.parent / RESOLVED_FILE).is_file():
        run, env_id = load_run(path.parent), (query.env or "").rpartition(":")[2]
        if not env_id:
            _check_unused(query, "the model of a run, unless --env is passed", "algo")
        if env_id in ("", run.experiment.env_id) and query.algo in (None, run.experiment.algo):
            register_run(run)
            return _agent_of_run(run, path, query.device)
    if query.env is None:
        raise CommandError(f"pass --env with {path}: a model file does not contain the environment id")
    env_id, algo = known_env_id(query.env), query.algo or algorithm_of(path)
    return Agent(load_model(path, algo, query.device), path, query.algo or path.stem, env_id)


def algorithm_of(path: Path) -> str:
    """Return an algorithm that can load a model file, by the policy class and the arguments in the file."""
    with refused(f"{path} cannot be read as a model of Stable-Baselines3"), path.open("rb") as file:
        data, _, _ = load_from_zip_file(file, device="cpu", custom_objects=UNUSED_OBJECTS)
        assert data is not None, "it contains no data"
    policy = data.get("policy_class")
    scores = {
        name: sum(1 if key in data else -1 for key in constructor_arguments(algorithm))
        for name, algorithm in algorithm_classes().items()
        if policy in algorithm.policy_aliases.values()
    }
    if not scores:
        raise CommandError(f"pass --algo with {path}: no known algorithm has the policy class {policy}")
    return max(scores, key=lambda name: scores[name])


def load_model(
    path: Path, algo: str, device: str = "auto", objects: Mapping[str, Any] = UNUSED_OBJECTS
) -> BaseAlgorithm:
    """Load a model file without a replay buffer, by default only for acting."""
    algorithms = algorithm_classes()
    check_names("algorithm", [algo], algorithms)
    if not path.is_file():
        raise CommandError(f"{path} does not exist")
    # An agent needs no replay buffer. SB3's allocate memory, and HerReplayBuffer needs an environment.
    has_buffer = algo not in ALGORITHMS and "buffer_size" in constructor_arguments(algorithms[algo])
    buffer = {"replay_buffer": ()} if has_buffer else {}
    with refused(f"{path} is damaged or from another version"):
        model: BaseAlgorithm = algorithms[algo].load(
            path, device=device, custom_objects=dict(objects), **buffer
        )
    return model


def _published_agent(query: AgentQuery) -> Agent:
    if query.path is not None:
        raise CommandError("--published names an agent: pass no path")
    _check_unused(query, "--published", "env", "algo", "preset", "load_best")
    card = find_published(str(query.published), query.baseline)
    register_environments(card.gym_packages)
    known_env_id(card.env)
    model = load_published(card, query.device)
    return Agent(model, card.model_file, card.label, card.env, dict(card.env_kwargs))


def load_published(card: Card, device: str = "auto") -> BaseAlgorithm:
    """Load a published agent from its card."""
    return load_model(card.model_file, card.algo, device, objects={})
