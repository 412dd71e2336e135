"""Valid values of hyperparameters for which an algorithm fails late, or not at all."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from zoo_configs.errors import CommandError

SCHEDULE_PREFIX = "lin_"
PERIOD_UNITS = ("step", "episode")


def _is_number(value: Any, low: float = -math.inf, high: float = math.inf) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and math.isfinite(value) and low <= value <= high


def _is_whole(value: Any, low: int) -> bool:
    return isinstance(value, int) and _is_number(value, low)


def _is_rate(value: Any) -> bool:
    if isinstance(value, str) and value.startswith(SCHEDULE_PREFIX):
        try:
            value = float(value.removeprefix(SCHEDULE_PREFIX))
        except ValueError:
            return False
    return _is_number(value, 0)


def _is_period(value: Any) -> bool:
    number, unit = value if isinstance(value, list | tuple) and len(value) == 2 else (value, "step")
    return _is_whole(number, 1) and unit in PERIOD_UNITS


COUNT = ("a whole number of at least 1", lambda value: _is_whole(value, 1))
SHARE = ("a number from 0 to 1", lambda value: _is_number(value, 0, 1))
ARGUMENTS = ("a mapping of arguments", lambda value: isinstance(value, Mapping | str | None))
RANGES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "action_noise": ("None (set noise_type and noise_std instead)", lambda value: value is None),
    "env_kwargs": ("a mapping of parameters", lambda value: isinstance(value, Mapping)),
    "gradient_steps": ("a whole number of at least -1", lambda value: _is_whole(value, -1)),
    "learning_rate": (f"a number of at least 0, or {SCHEDULE_PREFIX}NUMBER", _is_rate),
    "learning_starts": ("a whole number of at least 0", lambda value: _is_whole(value, 0)),
    "n_timesteps": ("a number of at least 1", lambda value: _is_number(value, 1)),
    "policy": ("a name", lambda value: isinstance(value, str)),
    "train_freq": ("a whole number of at least 1, or [number, 'step' or 'episode']", _is_period),
    **dict.fromkeys(("batch_size", "buffer_size", "frame_stack", "n_envs", "n_epochs", "n_steps"), COUNT),
    "target_update_interval": COUNT,
    **dict.fromkeys(("gamma", "tau"), SHARE),
    **dict.fromkeys(("monitor_kwargs", "policy_kwargs", "replay_buffer_kwargs"), ARGUMENTS),
}
"""Description and check of valid values, by hyperparameter."""


def check_values(hyperparams: Mapping[str, Any]) -> None:
    """Raise ``CommandError`` for an invalid value of a hyperparameter."""
    for name, (constraint, is_valid) in RANGES.items():
        if name in hyperparams and not is_valid(hyperparams[name]):
            raise CommandError(f"{name} must be {constraint}, got {hyperparams[name]!r}")
