"""Environment ids: the packages that register them, and their lookup by name."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from types import ModuleType
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from zoo_configs.errors import CommandError, reason, refused, unknown_name

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

ENV_PACKAGES = ("bulletarm_gym",)
NAMESPACE = "BulletArm/"
# An id, with the part that distinguishes our ids as its group.
ENV_ID = re.compile(r"(?:.*/)?(?:(?:close|open)loop)?(.*?)(?:-v\d+)?", re.IGNORECASE)


def register_environments(packages: Iterable[str] = ()) -> None:
    """
    Import the packages that register environments.

    :param packages: Packages in addition to ours, as in rl_zoo3's ``--gym-packages``
    :raises CommandError: if a package cannot be imported
    """
    for package in (*ENV_PACKAGES, *packages):
        with refused(f"package {package!r} cannot be imported"):
            importlib.import_module(package)


def our_env_ids() -> list[str]:
    """
    Return the ids of this project's environments.

    :return: The ids in the order of registration
    """
    return [env_id for env_id in gym.registry if env_id.startswith(NAMESPACE)]


def known_env_id(env_id: str) -> str:
    """
    Return a registered id.

    :param env_id: ``"BulletArm/CloseLoopBlockPicking-v0"``, also after ``"package:"``
    :return: The id in Gymnasium's registry
    :raises CommandError: if it is not registered, with the nearest id
    """
    register_environments(package_of(env_id))
    name = env_id.rpartition(":")[2]
    if name not in gym.registry:
        raise unknown_name("environment", name, gym.registry, id_core, "see bulletarm-zoo list")
    return name


def package_of(env_id: str) -> list[str]:
    """
    Return the package in front of an id.

    :param env_id: ``"BulletArm/CloseLoopBlockPicking-v0"``, also after ``"package:"``
    :return: The package, or an empty list
    """
    package = env_id.rpartition(":")[0]
    return [package] if package else []


def id_core(env_id: str) -> str:
    """Return the characteristic part of an id, such as ``blockpicking``."""
    core = ENV_ID.fullmatch(env_id)
    return core[1].lower() if core else env_id


def make_env(env_id: str, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> gym.Env[Any, Any]:
    """
    Make an environment with a user's parameters.

    :param env_id: Its id
    :param env_kwargs: Its parameters
    :param render_mode: Its render mode, None for that of the parameters
    :return: The environment
    :raises CommandError: if the environment rejects its parameters, with its reason
    """
    rendering = {} if render_mode is None else {"render_mode": render_mode}
    if (wanted := env_kwargs.get("render_mode", render_mode)) != render_mode and rendering:
        raise CommandError(f"render_mode must be {render_mode!r}, got {wanted!r}")
    with refused(f"{env_id} cannot be made"):
        return gym.make(env_id, **{**env_kwargs, **rendering})


def try_env(env_id: str, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> None:
    """
    Make an environment and reset it, so that it rejects its parameters before the work starts.

    :param env_id: Its id
    :param env_kwargs: Its parameters
    :param render_mode: Its render mode, None for that of the parameters
    :raises CommandError: if the environment rejects its parameters or cannot be reset
    """
    with closing(make_env(env_id, env_kwargs, render_mode)) as env, refused(f"{env_id} cannot be reset"):
        env.reset()
        if render_mode is not None:
            env.render()


def check_alike(env: gym.Env[Any, Any] | VecEnv, like: Any, what: str) -> None:
    """
    Check that an environment has the spaces of another one, or of an agent.

    :param env: The environment
    :param like: The other environment or agent, with ``observation_space`` and ``action_space``
    :param what: Beginning of the error
    :raises CommandError: if observations or actions have other shapes or bounds
    """
    from stable_baselines3.common.utils import check_for_correct_spaces

    with refused(what, ValueError):
        check_for_correct_spaces(env, like.observation_space, like.action_space)


def demonstrations() -> ModuleType:
    """
    Import the collection of demonstrations.

    :return: The module, with ``collect`` and ``load``
    """
    import bulletarm_gym.demonstrations

    return bulletarm_gym.demonstrations


def load_expert_data(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """
    Replace the path of a file of demonstrations by its episodes.

    :param hyperparams: Hyperparameters of an algorithm
    :return: The hyperparameters with episodes as ``expert_data``
    :raises CommandError: if the file cannot be read
    """
    path = hyperparams.get("expert_data")
    if not isinstance(path, str):
        return dict(hyperparams)
    try:
        return {**hyperparams, "expert_data": demonstrations().load(path)}
    except Exception as error:  # a damaged file can raise any error
        raise CommandError(f"expert_data: {path} cannot be read: {reason(error)}") from error


class CheckedDemonstrations:
    """
    Demonstrations whose environment ``check_expert_data`` has checked.

    They have no environment id, so that a learner accepts those of ``--allow-mismatched-demos`` as well.

    :param episodes: The demonstrations
    """

    env_id = None

    def __init__(self, episodes: Any) -> None:
        self._episodes = episodes

    def __iter__(self) -> Iterator[Any]:
        return iter(self._episodes)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._episodes, name)
