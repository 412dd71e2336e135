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
# An id, and in it what tells ours apart.
ENV_ID = re.compile(r"(?:.*/)?(?:(?:close|open)loop)?(.*?)(?:-v\d+)?", re.IGNORECASE)


def register_environments(packages: Iterable[str] = ()) -> None:
    """
    Import the packages that register environments.

    :param packages: Packages besides our own, as in rl_zoo3's ``--gym-packages``
    :raises CommandError: if one of them cannot be imported
    """
    for package in (*ENV_PACKAGES, *packages):
        with refused(f"package {package!r} cannot be imported"):
            importlib.import_module(package)


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
    register_environments(package_of(env_id))
    name = env_id.rpartition(":")[2]
    if name not in gym.registry:
        raise unknown_name("environment", name, gym.registry, _core, "see bulletarm-zoo list")
    return name


def package_of(env_id: str) -> list[str]:
    """
    The package that registers an environment, as far as its id says it.

    :param env_id: ``"BulletArm/CloseLoopBlockPicking-v0"``, also with a ``"package:"`` in front
    :return: That package, or nothing
    """
    package = env_id.rpartition(":")[0]
    return [package] if package else []


def _core(env_id: str) -> str:
    """``blockpicking`` for ``BulletArm/CloseLoopBlockPicking-v0``."""
    core = ENV_ID.fullmatch(env_id)
    return core[1].lower() if core else env_id


def make_env(env_id: str, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> gym.Env[Any, Any]:
    """
    Make an environment with a user's parameters.

    :param env_id: Its id
    :param env_kwargs: Its parameters
    :param render_mode: How it is to render; None leaves it to the parameters
    :return: The environment
    :raises CommandError: if it refuses its parameters, with the reason that it gives
    """
    rendering = {} if render_mode is None else {"render_mode": render_mode}
    if (wanted := env_kwargs.get("render_mode", render_mode)) != render_mode and rendering:
        raise CommandError(f"render_mode is {render_mode!r} here, got {wanted!r}")
    with refused(f"{env_id} cannot be made"):
        return gym.make(env_id, **{**env_kwargs, **rendering})


def try_env(env_id: str, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> None:
    """
    Make an environment and begin an episode, so that what it refuses is told before the work begins.

    :param env_id: Its id
    :param env_kwargs: Its parameters
    :param render_mode: How it is to render; None leaves it to the parameters
    :raises CommandError: if it refuses its parameters, or cannot begin with them
    """
    with closing(make_env(env_id, env_kwargs, render_mode)) as env, refused(f"{env_id} cannot begin"):
        env.reset()
        if render_mode is not None:
            env.render()


def check_alike(env: gym.Env[Any, Any] | VecEnv, like: Any, what: str) -> None:
    """
    Look whether an environment shows and takes the same as another, or as an agent knows it.

    :param env: The environment
    :param like: The other, or the agent: it has an ``observation_space`` and an ``action_space``
    :param what: What cannot be done if not
    :raises CommandError: if its observations or actions are of other shapes or bounds
    """
    from stable_baselines3.common.utils import check_for_correct_spaces

    with refused(what, ValueError):
        check_for_correct_spaces(env, like.observation_space, like.action_space)


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
    except Exception as error:  # whatever a file of unknown content raises
        raise CommandError(f"expert_data: {path} cannot be read: {reason(error)}") from error


class CheckedDemonstrations:
    """
    Demonstrations whose environment ``check_expert_data`` has compared with that of the run.

    They have no id of an environment, so that a learner accepts those that ``--allow-mismatched-demos`` accepts.

    :param episodes: The demonstrations
    """

    env_id = None

    def __init__(self, episodes: Any) -> None:
        self._episodes = episodes

    def __iter__(self) -> Iterator[Any]:
        return iter(self._episodes)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._episodes, name)
