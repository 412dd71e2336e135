"""Python objects for YAML hyperparameters: schedules, classes, wrappers, callbacks and action noise."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise

from zoo_configs.algorithms import class_from_path
from zoo_configs.errors import CommandError

ENV_KEYS = ("env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "normalize", "vec_env_wrapper")
"""Hyperparameters of the environments."""
TRAINER_KEYS = (*ENV_KEYS, "callback", "n_envs", "n_timesteps", "noise_std", "noise_type")
"""Hyperparameters that are not constructor arguments of an algorithm, with rl_zoo3's names."""
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")
SCHEDULE = re.compile(r"(lin_)(.+)")
"""Value that falls linearly to zero, with rl_zoo3's spelling."""
EVALUATED = ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "monitor_kwargs", "normalize")
"""Hyperparameters that rl_zoo3's files write as Python expressions, such as ``dict(net_arch=[64])``."""
NAMES = {"__builtins__": {}, "dict": dict, "nn": th.nn, "th": th}
"""Names that such an expression can use."""
DOTTED_PATH = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
NOISES: dict[str, Any] = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}


class LinearSchedule:
    """
    Schedule that falls linearly to zero.

    :param initial_value: Value at the start of the training
    """

    def __init__(self, initial_value: float) -> None:
        self.initial_value = float(initial_value)

    def __call__(self, progress_remaining: float) -> float:
        """Return the value at a fraction of the training that remains."""
        return progress_remaining * self.initial_value


def parsed(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """
    Replace descriptions by Python objects, except wrappers, callbacks and noise.

    :param hyperparams: Hyperparameters as in a YAML file
    :return: A copy with schedules, classes and tuples
    """
    values = {key: _evaluate(value) if key in EVALUATED else value for key, value in hyperparams.items()}
    for key in ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"):
        if key in values:
            values[key] = import_classes(values[key], is_class=key.endswith("_class"))
    if "." in (policy := values.get("policy", "")):
        values["policy"] = class_from_path(policy)
    for key in SCHEDULES:
        if isinstance(value := values.get(key), str) and (schedule := SCHEDULE.fullmatch(value)):
            values[key] = LinearSchedule(float(schedule[2]))
    if isinstance(values.get("train_freq"), list):
        values["train_freq"] = tuple(values["train_freq"])
    return values


def _evaluate(value: Any) -> Any:
    """Evaluate a Python expression as rl_zoo3 does; leave import paths and other values as they are."""
    if not isinstance(value, str) or DOTTED_PATH.fullmatch(value):
        return value
    return eval(value, dict(NAMES))


def import_classes(value: Any, is_class: bool = False) -> Any:
    """
    Replace import paths by classes wherever a key ends in ``_class``.

    :param value: A value from a YAML file
    :param is_class: Whether the value has such a key
    :return: The value with classes
    """
    if isinstance(value, dict):
        return {key: import_classes(item, str(key).endswith("_class")) for key, item in value.items()}
    if is_class and isinstance(value, str) and DOTTED_PATH.fullmatch(value):
        return class_from_path(value)
    return value


def wrapper(description: Any) -> Callable[[Any], Any] | None:
    """
    Build a function that wraps environments.

    :param description: None, an import path, a mapping from one path to arguments, or a list of these
    :return: The function, None if nothing is described
    """
    classes = _described_classes(description)

    def wrap(env: Any) -> Any:
        for cls, kwargs in classes:
            env = cls(env, **kwargs)
        return env

    return wrap if classes else None


def callbacks(description: Any) -> list[BaseCallback]:
    """
    Build the callbacks of the hyperparameter ``callback``.

    :param description: As for :func:`wrapper`
    :return: The callbacks
    """
    return [cls(**kwargs) for cls, kwargs in _described_classes(description)]


def _described_classes(description: Any) -> list[tuple[type[Any], dict[str, Any]]]:
    if description is None:
        return []
    entries = description if isinstance(description, list) else [description]
    pairs = [next(iter(entry.items())) if isinstance(entry, dict) else (entry, {}) for entry in entries]
    return [(class_from_path(path), dict(kwargs)) for path, kwargs in pairs]


def action_noise(noise_type: str, std: float, action_space: spaces.Space[Any]) -> ActionNoise:
    """
    Build the noise of ``noise_type`` and ``noise_std``.

    :param noise_type: ``"normal"`` or ``"ornstein-uhlenbeck"``
    :param std: Standard deviation
    :param action_space: Action space of the environment
    :return: The noise
    :raises CommandError: for another noise type, or a space without a number of dimensions
    """
    if noise_type not in NOISES or not isinstance(action_space, spaces.Box):
        raise CommandError(
            f"noise_type must be one of {', '.join(NOISES)} and needs a Box action space, "
            f"got {noise_type!r} and {action_space}"
        )
    ones = np.ones(action_space.shape)
    noise: ActionNoise = NOISES[noise_type](mean=0 * ones, sigma=std * ones)
    return noise
