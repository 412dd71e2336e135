"""Demonstrations that users pass: loading, and validation against the training environment."""

import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.env_metadata import RANGES, SEQUENCE, env_attribute
from sb3_extensions.common.observations import as_parts, space_parts
from sb3_extensions.demonstrations.episodes import EpisodeData

ExpertData = Iterable[EpisodeData] | str | os.PathLike[str]
"""Episodes, or the path of a file of ``bulletarm_gym.demonstrations``."""

ACTION_SPACE = "action_space"
RELATIVE_TOLERANCE = 1e-5
"""Allowed excess over the bounds of a space, relative to its range: files store rounded numbers."""
MAX_FLOAT32 = float(np.finfo(np.float32).max)
REWARD_SPACE = spaces.Box(-MAX_FLOAT32, MAX_FLOAT32, ())
TERMINATION_SPACE = spaces.Box(0.0, 1.0, ())


def load_episodes(data: ExpertData | None) -> Iterable[EpisodeData] | None:
    """
    Return episodes that were passed or that are in a file, or None.

    :raises ImportError: if ``data`` is a path and bulletarm-gym is not installed
    :raises OSError: if the file cannot be opened
    :raises ValueError: if the file is not a file of demonstrations, or ``data`` is something else
    """
    if not isinstance(data, Iterable | os.PathLike | None):
        raise ValueError(f"expert_data must be an iterable of episodes or the path of a file, got {data!r}")
    if not isinstance(data, str | os.PathLike):
        return data
    try:
        from bulletarm_gym.demonstrations import load
    except ImportError as error:
        raise ImportError(f"expert_data={data!r} requires: pip install bulletarm-gym") from error
    return load(data)


def validate_episodes(data: Iterable[EpisodeData], env: VecEnv) -> Iterator[EpisodeData]:
    """
    Yield episodes that fit an environment.

    :param data: episodes. The attributes ``env_id``, ``action_sequence``, ``action_ranges`` and
        ``action_space`` are optional. A Minari data set has them in its ``env_spec``
    :param env: training environment
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
        _validate_episode(episode, env, number)
        yield episode


def _error(must: str, got: Any, number: int) -> ValueError:
    return ValueError(f"expert_data must have {must}, got {got} in episode {number}")


def _validate_episode(episode: EpisodeData, env: VecEnv, number: int) -> None:
    for name in ("observations", "actions", "rewards", "terminations"):
        if not hasattr(episode, name):
            raise _error(f"episodes with the attribute {name!r}", type(episode).__name__, number)
    entries, observations = space_parts(env.observation_space), episode.observations
    if not isinstance(env.observation_space, spaces.Dict):
        observations = as_parts(observations)
    if not isinstance(observations, Mapping) or not entries.keys() <= observations.keys():
        found = sorted(observations) if isinstance(observations, Mapping) else type(observations).__name__
        raise _error(f"observations with the keys {sorted(entries)}", found, number)
    n_steps = len(np.atleast_1d(_as_array("actions", episode.actions, number)))
    if n_steps == 0:
        raise _error("at least one step in an episode", 0, number)
    columns = {"actions": env.action_space, "rewards": REWARD_SPACE, "terminations": TERMINATION_SPACE}
    if getattr(episode, "expert_actions", None) is not None:
        columns["expert_actions"] = env.action_space
    for name, part_space in columns.items():
        _check(name, getattr(episode, name), n_steps, part_space, number)
    for key, entry in entries.items():
        _check(f"observations[{key!r}]", observations[key], n_steps + 1, entry, number)
    if early := np.flatnonzero(episode.terminations[:-1]).tolist():
        got = f"one at step {early[0]} of {n_steps}"
        raise _error("terminations at the last step of an episode only", got, number)


def _as_array(name: str, values: Any, number: int) -> npt.NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError as error:
        raise _error(f"an array of {name}", f"the error {error}", number) from error


def _check(name: str, values: Any, length: int, space: spaces.Space[Any], number: int) -> None:
    """Check the shape of an array, and that its values are numbers within the bounds of a Box."""
    numbers = _as_array(name, values, number)
    shape = (length, *(space.shape or ()))
    if numbers.shape != shape:
        raise _error(f"{name} of shape {shape}", numbers.shape, number)
    if not isinstance(space, spaces.Box):
        return
    if numbers.dtype.kind not in ("buif" if np.issubdtype(space.dtype, np.floating) else "bui"):
        raise _error(f"{name} of a type that converts to {space.dtype}", numbers.dtype, number)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    width = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(low), np.abs(high)))
    tolerance = RELATIVE_TOLERANCE * np.where(np.isfinite(width), width, 0.0)
    # The comparisons are False for NaN.
    if not ((numbers >= low - tolerance) & (numbers <= high + tolerance)).all():
        got = f"{numbers.min():g} to {numbers.max():g}"
        raise _error(f"{name} from {low.min():g} to {high.max():g}", got, number)


def _check_env_id(data: Any, env: VecEnv) -> None:
    """Check that the episodes are of a training environment, if the data name theirs."""
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
    """Return an attribute of a data set, for a Minari data set also a parameter of its environment."""
    value = getattr(data, name, None)
    spec = getattr(data, "env_spec", None)
    return spec.kwargs.get(name) if value is None and spec is not None else value
