"""Search spaces: the hyperparameters that a study changes, and their values."""

from __future__ import annotations

import functools
import inspect
import json
import math
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import optuna

from zoo_configs.algorithms import algorithm_classes, constructor_arguments
from zoo_configs.errors import CommandError, check_names, unknown_name
from zoo_configs.experiments.config import ExperimentConfig, merge
from zoo_configs.training.objects import SCHEDULE, TRAINER_KEYS
from zoo_configs.yaml_files import parse_yaml, read_yaml

SHIPPED = "algorithms.yml"
KEYS = ("low", "high", "log", "choices", "needs")
BASELINE = "baseline"
"""Attribute of the trial that trains the baseline itself."""


class Parameter(NamedTuple):
    """
    A hyperparameter of a search space.

    :param name: Its name; dots lead into mappings
    :param low: Lower bound
    :param high: Upper bound
    :param log: Whether the scale is logarithmic
    :param integer: Whether the values are whole numbers
    :param choices: The values of a parameter without bounds
    :param needs: Hyperparameter that must not be 0 in the baseline, empty for none
    """

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    integer: bool = False
    choices: tuple[Any, ...] = ()
    needs: str = ""

    def suggest(self, trial: optuna.Trial) -> Any:
        """
        Sample a value.

        :param trial: The trial
        :return: The value
        """
        if self.choices:
            return json.loads(trial.suggest_categorical(self.name, [json.dumps(c) for c in self.choices]))
        if self.integer:
            return trial.suggest_int(self.name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)

    def optuna_value(self, value: Any) -> Any:
        """
        Return a value as Optuna stores it.

        :param value: The value
        :return: The stored value, None if the space does not contain it
        """
        if self.choices:
            return next((json.dumps(choice) for choice in self.choices if _equal(choice, value)), None)
        return value if _is_number(value) and self.low <= value <= self.high else None

    def including(self, value: Any) -> Parameter:
        """
        Return the parameter with a value added to its choices or within its bounds.

        :param value: The value, None for an unknown one
        """
        if value is None or self.optuna_value(value) is not None:
            return self
        if self.choices:
            return self._replace(choices=(value, *self.choices))
        if not _is_number(value) or (self.log and value <= 0):
            return self
        return self._replace(low=min(self.low, value), high=max(self.high, value))


def load_space(experiment: ExperimentConfig, path: Path | None = None) -> tuple[Parameter, ...]:
    """
    Load the search space of an experiment.

    Whole-number bounds mean whole numbers, unless the hyperparameter is a float.

    :param experiment: The experiment
    :param path: A YAML file with a space, None for the one of the algorithm
    :return: Its parameters
    :raises CommandError: for an invalid file, an algorithm without space, or an unknown hyperparameter
    """
    if path is not None:
        space = parse_space(str(path), read_yaml(path, "--space"))
    else:
        spaces = _shipped_spaces()
        names = [name for name in spaces if not name.startswith("_")]
        if experiment.algo not in names:
            raise unknown_name("search space", experiment.algo, names, see="use --space")
        space = parse_space(f"the space of {experiment.algo}", spaces[experiment.algo])
    _check_names(space, experiment)
    return tuple(parameter._replace(integer=_is_integer(parameter, experiment)) for parameter in space)


@functools.cache
def _shipped_spaces() -> dict[str, Any]:
    folder = resources.files("zoo_configs") / "hyperparams" / "spaces"
    return dict(parse_yaml((folder / SHIPPED).read_text(encoding="utf-8")))


def parse_space(where: str, data: Any) -> tuple[Parameter, ...]:
    """
    Parse a search space.

    :param where: Its name in errors
    :param data: Bounds or choices by name
    :return: Its parameters
    :raises CommandError: if it is invalid
    """
    if not isinstance(data, Mapping) or not data:
        raise CommandError(f"{where} must be a mapping of parameters, got {data!r}")
    return tuple(_parse_parameter(where, str(name), given) for name, given in data.items())


def _parse_parameter(where: str, name: str, given: Any) -> Parameter:
    if not isinstance(given, Mapping):
        raise CommandError(f"{name} of {where} must have low and high, or choices, got {given!r}")
    check_names(f"key of {name} of {where}", map(str, given), KEYS)
    if "choices" in given:
        choices = given["choices"]
        if given.keys() - {"choices", "needs"} or not isinstance(choices, list) or not choices:
            raise CommandError(f"{name} of {where}: choices must be a list without bounds, got {dict(given)}")
        return Parameter(name, choices=tuple(choices), needs=given.get("needs", ""))
    low: Any = given.get("low")
    high: Any = given.get("high")
    least = 0 if given.get("log") else -math.inf
    if not (_is_number(low) and _is_number(high) and least < low < high):
        positive = "positive " if given.get("log") else ""
        raise CommandError(f"{name} of {where} must have {positive}numbers low < high, got {dict(given)}")
    return Parameter(name, **given)


def _check_names(space: tuple[Parameter, ...], experiment: ExperimentConfig) -> None:
    """
    Check that the algorithm has the hyperparameters of a space.

    :raises CommandError: for an unknown one
    """
    from sb3_extensions.common.env_metadata import constructor_keys

    valid = {"policy", *TRAINER_KEYS, *constructor_keys(algorithm_classes()[experiment.algo])}
    names = [parameter.name.partition(".")[0] for parameter in space]
    check_names(f"hyperparameter of {experiment.algo} in the search space", names, valid)


def _is_integer(parameter: Parameter, experiment: ExperimentConfig) -> bool:
    bounds = (parameter.low, parameter.high)
    if parameter.choices or not all(isinstance(bound, int) for bound in bounds):
        return False
    argument = _argument(parameter.name, experiment)
    is_float = isinstance(baseline_value(parameter.name, experiment), float)
    return not is_float and (argument is None or "float" not in str(argument.annotation))


def fit_space(
    space: tuple[Parameter, ...], experiment: ExperimentConfig, given: Mapping[str, Any], is_own: bool
) -> tuple[Parameter, ...]:
    """
    Fit a space to an experiment: it contains the baseline's values, and only hyperparameters that it uses.

    :param space: The space
    :param experiment: The experiment
    :param given: Hyperparameters of the command line, which only a user's own space changes
    :param is_own: Whether the space is the user's own
    :return: The space to search
    :raises CommandError: if nothing is left to search
    """
    kept = [parameter for parameter in space if is_own or parameter.name.partition(".")[0] not in given]
    used = [
        parameter for parameter in kept if not parameter.needs or baseline_value(parameter.needs, experiment)
    ]
    if not used:
        raise CommandError(
            "the search space has no hyperparameter left: the command line defines all of them"
        )
    return tuple(parameter.including(baseline_value(parameter.name, experiment)) for parameter in used)


def baseline_value(name: str, experiment: ExperimentConfig) -> Any:
    """
    Return the value of a hyperparameter, of a schedule its initial value.

    :param name: Its name; dots lead into mappings
    :param experiment: The experiment
    :return: Its value, or the algorithm's default, None if unknown
    """
    value = _look_up(experiment.hyperparams, name)
    argument = _argument(name, experiment)
    if value is None and argument is not None and argument.default is not argument.empty:
        value = argument.default
    if isinstance(value, str) and (schedule := SCHEDULE.fullmatch(value)):
        return float(schedule[2])
    return value


def _argument(name: str, experiment: ExperimentConfig) -> inspect.Parameter | None:
    """Return the constructor's argument of a hyperparameter, None if it has none."""
    algorithm: Any = algorithm_classes()[experiment.algo]
    return constructor_arguments(algorithm).get(name)


def first_values(space: tuple[Parameter, ...], experiment: ExperimentConfig) -> dict[str, Any]:
    """
    Return the baseline's values, as far as they are known: the parameters of the first trial.

    :param space: The space
    :param experiment: The experiment
    :return: The values by name, as Optuna stores them
    """
    pairs = ((p.name, p.optuna_value(baseline_value(p.name, experiment))) for p in space)
    return {name: value for name, value in pairs if value is not None}


def sample_params(
    experiment: ExperimentConfig, space: tuple[Parameter, ...], trial: optuna.Trial
) -> dict[str, Any]:
    """
    Sample the hyperparameters of a trial.

    :param experiment: The experiment
    :param space: Its search space
    :param trial: The trial
    :return: Values that replace those of the experiment; none in the trial of the baseline
    """
    if trial.user_attrs.get(BASELINE):
        known = first_values(space, experiment)
        for parameter in space:
            if parameter.name in known:
                parameter.suggest(trial)
        return {}
    sampled: dict[str, Any] = {}
    for name, value in _sampled(experiment, space, trial):
        for key in reversed(name.split(".")):
            value = {key: value}
        sampled = merge(sampled, value)
    return sampled


def _sampled(
    experiment: ExperimentConfig, space: tuple[Parameter, ...], trial: optuna.Trial
) -> Iterator[tuple[str, Any]]:
    """Return the sampled values by name; a schedule keeps its form."""
    for parameter in space:
        value, before = parameter.suggest(trial), _look_up(experiment.hyperparams, parameter.name)
        if isinstance(before, str) and (schedule := SCHEDULE.fullmatch(before)) and not parameter.choices:
            value = f"{schedule[1]}{value}"
        yield parameter.name, value


def _look_up(mapping: Mapping[str, Any], name: str) -> Any:
    found: Any = mapping
    for key in name.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _equal(left: Any, right: Any) -> bool:
    """Return True for equal values: 1 equals 1.0, but not true."""
    return bool(left == right) and isinstance(left, bool) == isinstance(right, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
