"""Checks that demonstrations fit the environment to train in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.following import RANGES, SEQUENCE
from sb3_extensions.demonstrations.collecting import EpisodeData
from sb3_extensions.replay.buffer import KEY

ACTION_SPACE = "action_space"
"""Attribute of environments and of data sets."""


def checked_episodes(data: Iterable[EpisodeData], env: VecEnv) -> Iterator[EpisodeData]:
    """
    Return episodes, each checked when it is read.

    :param data: episodes; meanings of actions are compared where the data set has them as attributes
    :param env: environment to train in
    :return: the episodes
    :raises ValueError: if the actions have other meanings, or shapes differ from those of the spaces
    """
    for name in (SEQUENCE, RANGES, ACTION_SPACE):
        theirs, ours = _attribute(data, name), _attribute_of_env(env, name)
        if theirs is not None and ours is not None and theirs != ours:
            raise ValueError(f"expert_data must have {name}={ours!r}, as the environment, got {theirs!r}")
    shapes = _shapes_of_space(env.observation_space)
    for number, episode in enumerate(data):
        _check(number, "observations", shapes, _shapes_of_episode(episode.observations, shapes))
        _check(number, "actions", env.action_space.shape, np.shape(episode.actions)[1:])
        yield episode


def _check(number: int, name: str, must: Any, got: Any) -> None:
    if must != got:
        raise ValueError(
            f"expert_data must have {name} of the environment's shapes {must}, got {got} in episode {number}"
        )


def _shapes_of_space(space: spaces.Space[Any]) -> dict[str, Any]:
    parts: Mapping[str, Any] = space.spaces if isinstance(space, spaces.Dict) else {KEY: space}
    return {key: part.shape for key, part in parts.items()}


def _shapes_of_episode(observations: Any, needed: Mapping[str, Any]) -> Any:
    """Return the shapes of single observations by key; without further keys if all needed ones are there."""
    if not isinstance(observations, Mapping):
        return np.shape(observations)[1:]
    shapes = {key: np.shape(values)[1:] for key, values in observations.items()}
    return {key: shapes[key] for key in needed} if needed.keys() <= shapes.keys() else shapes


def _attribute(data: Any, name: str) -> Any:
    """Return an attribute of a data set; of a Minari data set, also a parameter of its environment."""
    value = getattr(data, name, None)
    spec = getattr(data, "env_spec", None)
    return spec.kwargs.get(name) if value is None and spec is not None else value


def _attribute_of_env(env: VecEnv, name: str) -> Any:
    """Return an attribute of the first environment, None where it has none."""
    if name == ACTION_SPACE:
        return env.action_space
    return env.get_attr(name, 0)[0] if env.has_attr(name) else None
