"""Search spaces as data: which hyperparameters a study moves, and between which values."""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import optuna
import yaml

from zoo_configs.cells.cell import Cell, merge
from zoo_configs.errors import CommandError, refused, unknown_name

SHIPPED = "algorithms.yml"
KEYS = ("low", "high", "log", "integer", "choices")
# A learning rate that falls linearly to zero, as rl_zoo3 spells it.
SCHEDULE = re.compile(r"(lin_)(.+)")


class Parameter(NamedTuple):
    """
    A hyperparameter to be searched.

    :param name: Its name; dots lead into mappings
    :param low: The least value of one with bounds
    :param high: The greatest
    :param log: Whether the scale is logarithmic
    :param integer: Whether only whole numbers are meant
    :param choices: The values of one without bounds
    """

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    integer: bool = False
    choices: tuple[Any, ...] = ()

    def suggest(self, trial: optuna.Trial) -> Any:
        """
        Draw a value.

        :param trial: The trial that is to have it
        :return: The value
        """
        if self.choices:
            return json.loads(
                trial.suggest_categorical(self.name, [json.dumps(item) for item in self.choices])
            )
        if self.integer:
            return trial.suggest_int(self.name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)

    def holds(self, value: Any) -> bool:
        """Whether a value lies in the space."""
        if self.choices:
            return value in self.choices
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number and self.low <= value <= self.high

    def as_param(self, value: Any) -> Any:
        """The value as Optuna keeps it."""
        return json.dumps(value) if self.choices else value


def load_space(algo: str, path: Path | None = None) -> tuple[Parameter, ...]:
    """
    The search space of an algorithm.

    :param algo: Name of the algorithm
    :param path: A user's own space, in YAML: a mapping of parameters
    :return: Its parameters
    :raises CommandError: if there is none, or the file says something else
    """
    if path is not None:
        with refused(f"--space: {path} cannot be read"):
            return parse_space(str(path), yaml.safe_load(path.read_text(encoding="utf-8")))
    folder = resources.files("zoo_configs") / "hyperparams" / "spaces"
    spaces = yaml.safe_load((folder / SHIPPED).read_text(encoding="utf-8"))
    names = [name for name in spaces if not name.startswith("_")]
    if algo not in names:
        raise unknown_name("search space", algo, names, see="give one by --space")
    return parse_space(f"the space of {algo}", spaces[algo])


def parse_space(where: str, data: Any) -> tuple[Parameter, ...]:
    """
    Read a search space.

    :param where: What its errors call it
    :param data: From name to bounds or choices
    :return: Its parameters
    :raises CommandError: if it says something else
    """
    if not isinstance(data, Mapping) or not data:
        raise CommandError(f"{where} takes a mapping of parameters, got {data!r}")
    return tuple(_parse_parameter(where, str(name), given) for name, given in data.items())


def _parse_parameter(where: str, name: str, given: Any) -> Parameter:
    if not isinstance(given, Mapping):
        raise CommandError(f"{name} of {where} takes low and high, or choices, got {given!r}")
    for key in given:
        if key not in KEYS:
            raise unknown_name(f"key of {name} of {where}", str(key), KEYS)
    if "choices" in given:
        if len(given) > 1 or not isinstance(given["choices"], list) or not given["choices"]:
            raise CommandError(f"{name} of {where}: choices takes a list and stands alone, got {dict(given)}")
        return Parameter(name, choices=tuple(given["choices"]))
    low, high = given.get("low"), given.get("high")
    least = 0 if given.get("log") else -math.inf
    if not (isinstance(low, int | float) and isinstance(high, int | float) and least < low < high):
        positive = " positive" if given.get("log") else ""
        raise CommandError(f"{name} of {where} takes{positive} numbers low < high, got {dict(given)}")
    return Parameter(name, **given)


def check_space(space: tuple[Parameter, ...], algorithm: type[Any]) -> None:
    """
    Look whether an algorithm takes what a space moves.

    :param space: The space
    :param algorithm: Class of the algorithm
    :raises CommandError: for a hyperparameter that it does not have
    """
    from sb3_extensions.common.env_metadata import constructor_keys
    from zoo_configs.training.objects import TRAINER_KEYS

    valid = {*TRAINER_KEYS, *constructor_keys(algorithm)}
    for parameter in space:
        if (name := parameter.name.partition(".")[0]) not in valid:
            raise unknown_name(f"hyperparameter of {algorithm.__name__} in the search space", name, valid)


def fit_space(
    space: tuple[Parameter, ...], cell: Cell, given: Mapping[str, Any], is_own: bool
) -> tuple[Parameter, ...]:
    """
    Bring a space into line with the values that the user has given for a cell.

    A shipped space leaves alone what was given; what it offers as choices, it offers besides the cell's own
    value. A user's own space searches all that it names, beginning with what was given.

    :param space: The space
    :param cell: The cell, with what was given in it
    :param given: Hyperparameters by name, as the user gave them
    :param is_own: Whether the space is the user's own
    :return: The space to search
    :raises CommandError: if a user's own space does not have a value that was given, or nothing is left
    """
    if is_own:
        for parameter in space:
            value = _number(_look_up(given, parameter.name, None))
            if value is not None and not parameter.holds(value):
                raise CommandError(f"{parameter.name} is {value!r}, which the search space does not have")
        return space
    left = tuple(_with_own(p, cell) for p in space if p.name.partition(".")[0] not in given)
    if not left:
        raise CommandError("nothing is left to search: all that the space of the algorithm has is given")
    return left


def _with_own(parameter: Parameter, cell: Cell) -> Parameter:
    """Choices with the cell's value among them, so that the first trial is the cell."""
    value = _look_up(cell.hyperparams, parameter.name, None)
    if not parameter.choices or value is None or value in parameter.choices:
        return parameter
    return parameter._replace(choices=(value, *parameter.choices))


def first_values(space: tuple[Parameter, ...], cell: Cell, algorithm: type[Any]) -> dict[str, Any]:
    """
    The baseline's values, as far as the space has them: the first trial.

    :param space: The space
    :param cell: The baseline
    :param algorithm: Class of its algorithm, whose defaults hold where the cell says nothing
    :return: From name to value, as Optuna keeps it
    """
    defaults = inspect.signature(algorithm).parameters
    values = {}
    for parameter in space:
        default = defaults[parameter.name].default if parameter.name in defaults else None
        value = _number(_look_up(cell.hyperparams, parameter.name, default))
        if parameter.holds(value):
            values[parameter.name] = parameter.as_param(value)
    return values


def moved(cell: Cell, space: tuple[Parameter, ...], trial: optuna.Trial) -> dict[str, Any]:
    """
    The hyperparameters of a trial.

    :param cell: The baseline
    :param space: What of it is searched
    :param trial: The trial
    :return: The baseline's hyperparameters with the trial's values in them
    """
    hyperparams = cell.hyperparams
    for parameter in space:
        value = parameter.suggest(trial)
        before = _look_up(hyperparams, parameter.name, None)
        if isinstance(before, str) and (schedule := SCHEDULE.fullmatch(before)) and not parameter.choices:
            value = f"{schedule[1]}{value}"
        for key in reversed(parameter.name.split(".")):
            value = {key: value}
        hyperparams = merge(hyperparams, value)
    return hyperparams


def _look_up(mapping: Mapping[str, Any], name: str, default: Any) -> Any:
    found: Any = mapping
    for key in name.split("."):
        if not isinstance(found, Mapping) or key not in found:
            return default
        found = found[key]
    return found


def _number(value: Any) -> Any:
    """What is searched of a schedule."""
    if isinstance(value, str) and (schedule := SCHEDULE.fullmatch(value)):
        return float(schedule[2])
    return value
