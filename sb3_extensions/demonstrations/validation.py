"""Validation of demonstrations against the spaces of the training environment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.env_metadata import RANGES, SEQUENCE, env_attribute
from sb3_extensions.demonstrations.episodes import EpisodeData
from sb3_extensions.replay.buffer import KEY

ACTION_SPACE = "action_space"
RELATIVE_TOLERANCE = 1e-5
"""Allowed excess over the bounds of a space, relative to its range: files store rounded numbers."""


def validate_episodes(data: Iterable[EpisodeData], env: VecEnv) -> Iterator[EpisodeData]:
    """
    Yield episodes that fit an environment.

    The attributes ``env_id``, ``action_sequence``, ``action_ranges`` and ``action_space`` of the data are
    optional. A Minari data set has them in its ``env_spec``.

    :param data: episodes
    :param env: training environment
    :return: the episodes
    :raises ValueError: if an attribute differs, or an episode has other shapes, values outside the bounds, or
        numbers that are not finite
    """
    _check_env_id(data, env)
    for name in (SEQUENCE, RANGES, ACTION_SPACE):
        theirs = _attribute(data, name)
        ours = env.action_space if name == ACTION_SPACE else env_attribute(env, name)
        if theirs is not None and ours is not None and theirs != ours:
            raise ValueError(f"expert_data must have {name}={ours!r}, as the environment, got {theirs!r}")
    for number, episode in enumerate(data):
        validate_episode(episode, env, number)
        yield episode


def validate_episode(episode: EpisodeData, env: VecEnv, number: int) -> None:
    """
    Check the shapes and values of an episode.

    :param episode: the episode
    :param env: training environment
    :param number: number of the episode, for messages
    :raises ValueError: if a shape or value does not fit
    """
    space = env.observation_space
    entries: Mapping[str, Any] = space.spaces if isinstance(space, spaces.Dict) else {KEY: space}
    shapes = {key: entry.shape for key, entry in entries.items()}
    _check_equal(number, "observations", shapes, _observation_shapes(episode.observations, shapes))
    _check_equal(number, "actions", env.action_space.shape, np.shape(episode.actions)[1:])
    for key, entry in entries.items():
        _check_values(number, f"observations[{key!r}]", episode.observations[key], entry)
    _check_values(number, "actions", episode.actions, env.action_space)
    intended = getattr(episode, "expert_actions", None)
    if intended is not None:
        _check_equal(number, "expert_actions", np.shape(episode.actions), np.shape(intended))
        _check_values(number, "expert_actions", intended, env.action_space)
    _check_equal(number, "rewards", (len(episode.actions),), np.shape(episode.rewards))
    if not np.isfinite(episode.rewards).all():
        raise ValueError(
            f"expert_data must have finite rewards, got {_range(episode.rewards)} in episode {number}"
        )


def _check_equal(number: int, name: str, expected: Any, found: Any) -> None:
    if expected != found:
        raise ValueError(f"expert_data must have {name} of shape {expected}, got {found} in episode {number}")


def _check_values(number: int, name: str, values: Any, space: spaces.Space[Any]) -> None:
    """Check that values are finite where the space is bounded and within its bounds."""
    if not isinstance(space, spaces.Box):
        return
    numbers = np.asarray(values)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    width = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(low), np.abs(high)))
    tolerance = RELATIVE_TOLERANCE * np.where(np.isfinite(width), width, 0.0)
    if np.isnan(numbers).any() or (numbers < low - tolerance).any() or (numbers > high + tolerance).any():
        raise ValueError(
            f"expert_data must have {name} from {low.min():g} to {high.max():g}, got {_range(numbers)} in "
            f"episode {number}"
        )


def _range(values: Any) -> str:
    numbers = np.asarray(values, dtype=np.float64)
    missing = " with NaN" if np.isnan(numbers).any() else ""
    if np.isnan(numbers).all():
        return "NaN"
    return f"{np.nanmin(numbers):g} to {np.nanmax(numbers):g}{missing}"


def _observation_shapes(observations: Any, needed: Mapping[str, Any]) -> Any:
    """Return the shapes of single observations by key, only of the needed keys if all are present."""
    if not isinstance(observations, Mapping):
        return np.shape(observations)[1:]
    shapes = {key: np.shape(values)[1:] for key, values in observations.items()}
    return {key: shapes[key] for key in needed} if needed.keys() <= shapes.keys() else shapes


def _check_env_id(data: Any, env: VecEnv) -> None:
    """Check that the episodes are of a training environment, if their environment is known."""
    theirs = getattr(data, "env_id", None) or getattr(getattr(data, "env_spec", None), "id", None)
    if theirs is None:
        return
    ours = sorted({spec.id for spec in env.get_attr("spec") if spec is not None})
    if ours and theirs not in ours:
        raise ValueError(
            f"expert_data must be episodes of {', '.join(ours)}, got episodes of {theirs}. Pass "
            "list(expert_data) to use episodes of another environment"
        )


def _attribute(data: Any, name: str) -> Any:
    """Return an attribute of a data set; of a Minari data set, also a parameter of its environment."""
    value = getattr(data, name, None)
    spec = getattr(data, "env_spec", None)
    return spec.kwargs.get(name) if value is None and spec is not None else value
