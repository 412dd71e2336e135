"""Environment ids: the packages that register them, and their lookup by name."""

import importlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from typing import Any

import gymnasium as gym

from zoo_configs.errors import CommandError, reason, refused, unknown_name

ENV_PACKAGES = ("bulletarm_gym",)
NAMESPACE = "BulletArm/"


def register_environments(packages: Iterable[str] = ()) -> None:
    """Import our package and others that register environments; raise ``CommandError`` on failure."""
    for package in (*ENV_PACKAGES, *packages):
        with refused(f"package {package!r} cannot be imported"):
            importlib.import_module(package)


def our_env_ids() -> list[str]:
    """Return the ids of this project's environments in the order of registration."""
    return [env_id for env_id in gym.registry if env_id.startswith(NAMESPACE)]


def known_env_id(env_id: str) -> str:
    """
    Return an id, also after ``"package:"``, as it is in Gymnasium's registry.

    :raises CommandError: if it is not registered, with the nearest id
    """
    register_environments(package_of(env_id))
    name = env_id.rpartition(":")[2]
    if name not in gym.registry:
        raise unknown_name("environment", name, gym.registry, "see bulletarm-zoo list")
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


def try_env(env_id: str, env_kwargs: Mapping[str, Any]) -> None:
    """Raise ``CommandError`` if an environment rejects its parameters or cannot be reset."""
    with tried_env(env_id, env_kwargs):
        pass


def load_expert_data(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return hyperparameters in which episodes replace the path of a file of demonstrations.

    :raises CommandError: if the file cannot be read
    """
    path = hyperparams.get("expert_data")
    if not isinstance(path, str):
        return dict(hyperparams)
    from bulletarm_gym.demonstrations import load

    try:
        return {**hyperparams, "expert_data": load(path)}
    except Exception as error:  # a damaged file can raise any error
        raise CommandError(f"expert_data: {path} cannot be read: {reason(error)}") from error
