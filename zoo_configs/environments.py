"""Environments by their ids, the packages that register them, and the seeds of their scenes."""

import importlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from enum import IntEnum
from typing import Any

import gymnasium as gym
import numpy as np

from zoo_configs.errors import CommandError, reason, refused, unknown_name

NAMESPACE = "BulletArm/"


def register_environments(packages: Iterable[str] = ()) -> None:
    """Import our package and others that register environments; raise ``CommandError`` on failure."""
    for package in ("bulletarm_gym", *packages):
        with refused(f"package {package!r} cannot be imported", (Exception, SystemExit)):
            importlib.import_module(package)


def our_env_ids() -> list[str]:
    """Return the ids of this project's environments in the order of registration."""
    return [env_id for env_id in gym.registry if env_id.startswith(NAMESPACE)]


def known_env_id(env_id: str) -> str:
    """Return a registered id, also after ``"package:"``; raise ``CommandError`` if it is unknown."""
    register_environments(package_of(env_id))
    name = env_id.rpartition(":")[2]
    if name not in gym.registry:
        raise unknown_name("environment", name, gym.registry, "see bulletarm-zoo list, or --gym-packages")
    return name


def package_of(env_id: str) -> list[str]:
    """Return a list with the package in front of an id, such as ``my_tasks:ID``, or an empty list."""
    return list(filter(None, [env_id.rpartition(":")[0]]))


def make_env(env_id: str, env_kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """Make an environment; raise ``CommandError`` with its reason if it rejects its parameters."""
    with refused(f"{env_id} cannot be made"):
        return gym.make(env_id, **env_kwargs)


@contextmanager
def tried_env(env_id: str, env_kwargs: Mapping[str, Any]) -> Iterator[gym.Env[Any, Any]]:
    """Make and reset an environment, so that it rejects its parameters before the work starts; close it."""
    with closing(make_env(env_id, env_kwargs)) as env:
        with refused(f"{env_id} cannot be reset"):
            env.reset()
        yield env


def load_expert_data(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters with the episodes of a file for its path; raise ``CommandError`` on failure."""
    path = hyperparams.get("expert_data")
    if not isinstance(path, str):
        return dict(hyperparams)
    from bulletarm_gym.demonstrations import load

    try:
        return {**hyperparams, "expert_data": load(path)}
    except Exception as error:  # a damaged file can raise any error
        raise CommandError(f"expert_data: {path} cannot be read: {reason(error)}") from error


class SeedStream(IntEnum):
    """Purpose of an independent stream of seeds. Training itself uses the run's seed."""

    EVALUATION = 1
    TEST = 2
    PRETRAINING = 3
    SAMPLER = 4


def stream_seed(seed: int, stream: SeedStream, index: int = 0) -> int:
    """Return the seed below 2**31 at an index of a stream, for example the time step of an evaluation."""
    state = np.random.SeedSequence((seed, stream, index)).generate_state(1)
    return int(state[0]) % 2**31
