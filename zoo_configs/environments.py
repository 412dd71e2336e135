"""Environment ids: the packages that register them, and their lookup by name."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from types import ModuleType
from typing import Any

import gymnasium as gym

from zoo_configs.errors import CommandError, unknown_name

ENV_PACKAGES = ("bulletarm_gym",)
NAMESPACE = "BulletArm/"


def register_environments(packages: Iterable[str] = ()) -> None:
    """
    Import the packages that register environments.

    :param packages: Packages besides our own, as in rl_zoo3's ``--gym-packages``
    :raises CommandError: if one of them cannot be found
    """
    for package in (*ENV_PACKAGES, *packages):
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            raise CommandError(f"package {package!r} cannot be imported: {error}") from error


def our_env_ids() -> list[str]:
    """
    Ids of this project's environments.

    :return: The ids in order of registration
    """
    return [env_id for env_id in gym.registry if env_id.startswith(NAMESPACE)]


def known_env_id(env_id: str) -> str:
    """
    Check an id given by the user.

    :param env_id: ``"BulletArm/CloseLoopBlockPicking-v0"``, also with a ``"package:"`` in front
    :return: The id as Gymnasium's registry knows it
    :raises CommandError: if it is not registered; names the nearest id
    """
    package, _, name = env_id.rpartition(":")
    register_environments([package] if package else [])
    if name not in gym.registry:
        raise unknown_name("environment", name, gym.registry)
    return name


def demonstrations() -> ModuleType:
    """
    Our environments' collection of experts' episodes.

    :return: The module, with ``collect`` and ``load``
    """
    import bulletarm_gym.demonstrations

    return bulletarm_gym.demonstrations


def load_expert_data(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """
    Replace the path of a file of demonstrations by what is in it.

    :param hyperparams: Hyperparameters of an algorithm
    :return: The same, with episodes for ``expert_data``
    :raises CommandError: if there is no such file
    """
    path = hyperparams.get("expert_data")
    if not isinstance(path, str):
        return dict(hyperparams)
    try:
        return {**hyperparams, "expert_data": demonstrations().load(path)}
    except (OSError, ValueError) as error:
        raise CommandError(f"expert_data: {path} cannot be read: {error}") from error
