"""What values hyperparameters take, whatever the algorithm: those that would fail late, or never."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from zoo_configs.errors import CommandError

SCHEDULE = "lin_"  # rl_zoo3's prefix of a rate that falls to 0


class Range(NamedTuple):
    """
    What a hyperparameter takes.

    :param takes: In words
    :param holds: Whether a value is such
    """

    takes: str
    holds: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_rate(value: Any) -> bool:
    if isinstance(value, str) and value.startswith(SCHEDULE):
        try:
            value = float(value.removeprefix(SCHEDULE))
        except ValueError:
            return False
    return _is_number(value) and value >= 0


def _whole(least: int) -> Range:
    def holds(value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and value >= least

    return Range(f"a whole number of at least {least}", holds)


def _is_period(value: Any) -> bool:
    number, unit = value if isinstance(value, list | tuple) and len(value) == 2 else (value, "step")
    return COUNT.holds(number) and unit in ("step", "episode")


COUNT = _whole(1)
TIMESTEPS = Range("a number of at least 1", lambda value: _is_number(value) and value >= 1)
SHARE = Range("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= 1)
RATE = Range(f"a number of at least 0, or {SCHEDULE}NUMBER", _is_rate)
UPDATES = _whole(-1)
PERIOD = Range("a whole number of at least 1, or [number, 'step' or 'episode']", _is_period)
NO_NOISE = Range("None: what noise there is say noise_type and noise_std", lambda value: value is None)
ARGUMENTS = Range("a mapping of arguments", lambda value: isinstance(value, Mapping | str | None))
NAME = Range("a name", lambda value: isinstance(value, str))

RANGES = {
    "action_noise": NO_NOISE,
    "batch_size": COUNT,
    "buffer_size": COUNT,
    "env_kwargs": Range("a mapping of parameters", lambda value: isinstance(value, Mapping)),
    "frame_stack": COUNT,
    "gamma": SHARE,
    "gradient_steps": UPDATES,
    "learning_rate": RATE,
    "learning_starts": _whole(0),
    "monitor_kwargs": ARGUMENTS,
    "n_envs": COUNT,
    "n_epochs": COUNT,
    "n_steps": COUNT,
    "n_timesteps": TIMESTEPS,
    "policy": NAME,
    "policy_kwargs": ARGUMENTS,
    "replay_buffer_kwargs": ARGUMENTS,
    "target_update_interval": COUNT,
    "tau": SHARE,
    "train_freq": PERIOD,
}


def check_values(hyperparams: Mapping[str, Any]) -> None:
    """
    Check the values of hyperparameters that have a range.

    :param hyperparams: Hyperparameters, as in rl_zoo3's YAML
    :raises CommandError: for a value out of its range
    """
    for name, range_of_name in RANGES.items():
        if name in hyperparams and not range_of_name.holds(hyperparams[name]):
            raise CommandError(f"{name} takes {range_of_name.takes}, got {hyperparams[name]!r}")
