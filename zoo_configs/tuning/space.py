"""Search spaces: the hyperparameters that a study changes, and their values."""

import inspect
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import optuna

from sb3_extensions.common.env_metadata import constructor_arguments
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.errors import CommandError, check_names
from zoo_configs.experiments.config import ExperimentConfig, look_up, merge
from zoo_configs.files import read_yaml
from zoo_configs.training.objects import SCHEDULE
from zoo_configs.training.validation import check_experiment, valid_hyperparams

SPACES = Path(__file__).resolve().parents[1] / "hyperparams" / "spaces" / "algorithms.yml"
KEYS = ("low", "high", "log", "choices", "needs")
BASELINE = "baseline"
"""Attribute of the trial that trains the baseline itself."""


class Parameter(NamedTuple):
    """Bounds or choices of a hyperparameter; ``needs`` names one that must not be 0 in the baseline."""

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    integer: bool = False
    choices: tuple[Any, ...] = ()
    needs: str = ""

    def suggest(self, trial: optuna.Trial) -> Any:
        """Sample a value."""
        if self.choices:
            return json.loads(trial.suggest_categorical(self.name, [json.dumps(c) for c in self.choices]))
        if self.integer:
            return trial.suggest_int(self.name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)

    def optuna_value(self, value: Any) -> Any:
        """Return a value as Optuna stores it, None if the space does not contain it."""
        if self.choices:
            return next((json.dumps(choice) for choice in self.choices if _equal(choice, value)), None)
        return value if _is_number(value) and self.low <= value <= self.high else None

    def including(self, value: Any) -> "Parameter":
        """Return the parameter with a value, None for unknown, added to its choices or within its bounds."""
        if value is None or self.optuna_value(value) is not None:
            return self
        if self.choices:
            return self._replace(choices=(value, *self.choices))
        if not _is_number(value) or (self.log and value <= 0):
            return self
        return self._replace(low=min(self.low, value), high=max(self.high, value))


def load_space(
    experiment: ExperimentConfig, given: Mapping[str, Any], path: Path | None = None
) -> tuple[Parameter, ...]:
    """
    Return the search space of an experiment, which contains the baseline's values.

    The space of its algorithm has only hyperparameters that the baseline uses and the command line leaves.
    Whole-number bounds mean whole numbers, unless the hyperparameter is a float.

    :param given: Hyperparameters of the command line
    :param path: YAML file with a space of the user's, None for that of the algorithm
    :raises CommandError: for an invalid file, an algorithm without space, an unknown hyperparameter, or if
        nothing is left to search
    """
    algo = experiment.algo
    if path is not None:
        space = parse_space(str(path), read_yaml(path, "--space"))
    elif algo in (shipped := read_yaml(SPACES)):
        space = parse_space(f"the space of {algo}", shipped[algo])
        space = [parameter for parameter in space if _root(parameter.name) not in given]
    else:
        raise CommandError(f"no search space for {algo}. Use --space.")
    valid = valid_hyperparams(algorithm_classes()[algo]) - {"n_timesteps"}  # those of a trial are an option
    check_names(f"hyperparameter of {algo} in the search space", (_root(item.name) for item in space), valid)
    used = [item for item in space if not item.needs or baseline_value(item.needs, experiment)]
    if not used:
        raise CommandError("the search space is empty: the command line defines all of its hyperparameters")
    whole = [item._replace(integer=_is_integer(item, experiment)) for item in used]
    if path is not None:
        _check_values(whole, experiment)
    return tuple(item.including(baseline_value(item.name, experiment)) for item in whole)


def _check_values(space: Iterable[Parameter], experiment: ExperimentConfig) -> None:
    """Raise ``CommandError`` if an experiment cannot have the choices or the bounds of its parameters."""
    values = [(parameter, parameter.choices or (parameter.low, parameter.high)) for parameter in space]
    for parameter, (first, *_) in values:
        experiment = experiment.overridden(_nested(parameter, first, experiment))
    for parameter, several in values:
        for value in several:
            check_experiment(experiment.overridden(_nested(parameter, value, experiment)))


def parse_space(where: str, data: Any) -> list[Parameter]:
    """Return the parameters of a mapping; raise ``CommandError``, with ``where``, if it is invalid."""
    if not isinstance(data, Mapping) or not data:
        raise CommandError(f"{where} must be a mapping of parameters, got {data!r}")
    return [_parse_parameter(where, str(name), given) for name, given in data.items()]


def _parse_parameter(where: str, name: str, given: Any) -> Parameter:
    if not isinstance(given, Mapping):
        raise CommandError(f"{name} of {where} must have low and high, or choices, got {given!r}")
    check_names(f"key of {name} of {where}", map(str, given), KEYS)
    if not isinstance(given.get("log", False), bool) or not isinstance(given.get("needs", ""), str):
        raise CommandError(
            f"{name} of {where}: log must be true or false, and needs a name, got {dict(given)}"
        )
    if "choices" in given:
        choices = given["choices"]
        if given.keys() - {"choices", "needs"} or not isinstance(choices, list) or not choices:
            raise CommandError(f"{name} of {where}: choices must be a list without bounds, got {dict(given)}")
        return Parameter(name, choices=tuple(choices), needs=given.get("needs", ""))
    low: Any = given.get("low")
    high: Any = given.get("high")
    least = 0 if given.get("log") else -math.inf
    if not (_is_number(low) and _is_number(high) and least < low < high):
        kind = "positive numbers" if least == 0 else "numbers"
        raise CommandError(f"{name} of {where} must have {kind} low < high, got {dict(given)}")
    return Parameter(name, **given)


def _root(name: str) -> str:
    return name.partition(".")[0]


def _is_integer(parameter: Parameter, experiment: ExperimentConfig) -> bool:
    if parameter.choices or not all(isinstance(bound, int) for bound in (parameter.low, parameter.high)):
        return False
    argument = _argument(parameter.name, experiment)
    is_float = isinstance(baseline_value(parameter.name, experiment), float)
    return not is_float and (argument is None or "float" not in str(argument.annotation))


def baseline_value(name: str, experiment: ExperimentConfig) -> Any:
    """Return a hyperparameter's value, a schedule's first one, or the default; None if unknown."""
    value = look_up(experiment.hyperparams, name)
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
    """Return the baseline's values, as far as they are known: the parameters of the first trial."""
    pairs = ((p.name, p.optuna_value(baseline_value(p.name, experiment))) for p in space)
    return {name: value for name, value in pairs if value is not None}


def sample_params(
    experiment: ExperimentConfig, space: tuple[Parameter, ...], trial: optuna.Trial
) -> dict[str, Any]:
    """Return sampled values that replace those of the experiment; none in the trial of the baseline."""
    if trial.user_attrs.get(BASELINE):
        known = first_values(space, experiment)
        for parameter in space:
            if parameter.name in known:
                parameter.suggest(trial)
        return {}
    sampled: dict[str, Any] = {}
    for parameter in space:
        sampled = merge(sampled, _nested(parameter, parameter.suggest(trial), experiment))
    return sampled


def _nested(parameter: Parameter, value: Any, experiment: ExperimentConfig) -> dict[str, Any]:
    """Return the hyperparameters that give a parameter a value."""
    before = look_up(experiment.hyperparams, parameter.name)
    if isinstance(before, str) and (schedule := SCHEDULE.fullmatch(before)) and not parameter.choices:
        value = f"{schedule[1]}{value}"  # a schedule keeps its form
    root, *keys = parameter.name.split(".")
    for key in reversed(keys):
        value = {key: value}
    return {root: value}


def _equal(left: Any, right: Any) -> bool:
    """Return True for equal values: 1 equals 1.0, but not true."""
    return bool(left == right) and isinstance(left, bool) == isinstance(right, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
