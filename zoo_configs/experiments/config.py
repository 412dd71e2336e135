"""The hyperparameters of an experiment, from a baseline, a preset and an environment."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from zoo_configs.errors import CommandError, unknown_name
from zoo_configs.experiments.benchmarks import choose_benchmark, task_parameters
from zoo_configs.experiments.rules import Case, Family, Layer, families, family_of

OVERRIDES = Layer("command line")
"""Source of the values that replace those of the configuration files."""
GRID = "policy_kwargs.codec_kwargs"
GRID_FOLLOWS = {"theta_bounds": "half_rotation", "workspace_size": "workspace"}
"""Arguments of a codec, and the environment's parameter that each follows."""
EXTRACTOR = "policy_kwargs.features_extractor_kwargs"
WHOLE_TURN = (-math.pi, math.pi)
"""Yaws (rad) of the actions -1 and 1 without ``half_rotation``."""


@dataclass(frozen=True)
class ExperimentConfig:
    """
    An experiment without its seed: everything that training needs.

    :param algo: Name of the algorithm
    :param env_id: Id of the environment
    :param hyperparams: Hyperparameters, as in a section of rl_zoo3's YAML files
    :param flags: Defaults for flags of ``train``, by option name
    :param baseline: The baseline, None for hyperparameters from elsewhere
    :param preset: The preset, None for hyperparameters from elsewhere
    :param benchmark: The benchmark that defines the task's parameters, None for another task
    :param overrides: Hyperparameters that replace those of the baseline
    """

    algo: str
    env_id: str
    hyperparams: dict[str, Any]
    flags: dict[str, Any] = field(default_factory=dict)
    baseline: str | None = None
    preset: str | None = None
    benchmark: str | None = None
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name for titles and tables: the baseline, or else the algorithm."""
        return self.baseline or self.algo


def resolve(
    baseline: str,
    preset: str,
    env_id: str,
    overrides: Mapping[str, Any] | None = None,
    benchmark: str | None = None,
) -> ExperimentConfig:
    """
    Return the hyperparameters of an experiment.

    :param baseline: A baseline, for example ``"equi_sacfd"``
    :param preset: ``"cpu"``, ``"paper"`` or, for closed-loop tasks, ``"quick"``
    :param env_id: Id of the environment
    :param overrides: Hyperparameters that replace all others; mappings are merged
    :param benchmark: The benchmark that defines the task's parameters; None for the first that fits
    :return: The experiment
    :raises CommandError: for an unknown name, or a benchmark without the task or the network
    """
    return explain(baseline, preset, env_id, overrides, benchmark)[0]


def explain(
    baseline: str,
    preset: str,
    env_id: str,
    overrides: Mapping[str, Any] | None = None,
    benchmark: str | None = None,
) -> tuple[ExperimentConfig, dict[str, Layer]]:
    """
    Return an experiment, and where its values come from.

    :param baseline: As for :func:`resolve`
    :param preset: As for :func:`resolve`
    :param env_id: As for :func:`resolve`
    :param overrides: As for :func:`resolve`
    :param benchmark: As for :func:`resolve`
    :return: The experiment, and the layer of each value by dotted name
    :raises CommandError: as :func:`resolve`
    """
    family = family_of(env_id)
    case = _case(family, baseline, preset, env_id, benchmark)
    overrides = copy.deepcopy(dict(overrides or {}))
    layers = [*family.layers(case, _benchmark_layers(case)), Layer(OVERRIDES.source, hyperparams=overrides)]
    merged: dict[str, Any] = {"hyperparams": {}, "flags": {}}
    sources: dict[str, Layer] = {}
    for layer in layers:
        values: dict[str, Any] = {"hyperparams": layer.hyperparams, "flags": layer.flags}
        if layer.algo is not None:
            values["algo"] = layer.algo
        _merge_into(merged, values)
        sources.update({name: layer for name, _ in _leaves(values)})
    hyperparams, flags = merged["hyperparams"], merged["flags"]
    for name, parameter in _follow_environment(hyperparams, overrides):
        sources[f"hyperparams.{name}"] = sources[f"hyperparams.env_kwargs.{parameter}"]
    experiment = ExperimentConfig(
        merged["algo"], env_id, hyperparams, flags, baseline, preset, case.benchmark, overrides
    )
    return experiment, sources


def _benchmark_layers(case: Case) -> Iterator[Layer]:
    if case.benchmark is not None:
        source = f"bulletarm_gym.benchmarks, {case.benchmark}"
        yield Layer(source, hyperparams=task_parameters(case.benchmark, case.env_id))


def _case(family: Family, baseline: str, preset: str, env_id: str, benchmark: str | None) -> Case:
    if baseline not in family.baselines:
        if others := [other.envs for other in families() if baseline in other.baselines]:
            raise CommandError(f"baseline {baseline!r} is for {' or '.join(others)}, not for {env_id}")
        raise unknown_name("baseline", baseline, family.baselines)
    if preset not in family.presets:
        if others := [other.envs for other in families() if preset in other.presets]:
            names, where = ", ".join(sorted(family.presets)), " or ".join(others)
            raise CommandError(f"preset must be one of {names} for {env_id}, got {preset!r} for {where}")
        raise unknown_name("preset", preset, family.presets)
    parts = family.baselines[baseline]
    chosen = choose_benchmark(family.benchmarks, env_id, parts.network, benchmark)
    return Case(preset, env_id, chosen, parts)


def _leaves(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Return the values with dotted names; an empty mapping is a value."""
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def merge(base: Mapping[str, Any], update: Mapping[str, Any]) -> dict[str, Any]:
    """
    Merge two nested mappings.

    :param base: The values below
    :param update: The values on top; a mapping is merged with a mapping, anything else replaces
    :return: A new mapping that shares nothing with the two
    """
    merged = copy.deepcopy(dict(base))
    _merge_into(merged, update)
    return merged


def _merge_into(target: dict[str, Any], update: Mapping[str, Any]) -> None:
    for key, value in update.items():
        below = target.get(key)
        if isinstance(below, dict) and isinstance(value, Mapping):
            _merge_into(below, value)
        else:
            target[key] = copy.deepcopy(value)


def _follow_environment(
    hyperparams: dict[str, Any], overrides: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    """
    Derive arguments of the policy from the environment's parameters.

    :return: The dotted name of each derived value, and the parameter that it follows
    """
    env_kwargs = _at(hyperparams, "env_kwargs") or {}
    policy_kwargs = _at(hyperparams, "policy_kwargs") or {}
    if "action_sequence" in policy_kwargs and (sequence := env_kwargs.get("action_sequence")) is not None:
        policy_kwargs["action_sequence"] = sequence
        yield "policy_kwargs.action_sequence", "action_sequence"
    for name, value in _grid_bounds(env_kwargs):
        grid = _at(hyperparams, GRID)
        if grid is not None and name not in grid:
            grid[name] = value
            yield f"{GRID}.{name}", GRID_FOLLOWS[name]
    if _fit_image_size(hyperparams, overrides):
        yield f"{EXTRACTOR}.channels", "obs_size"


def _grid_bounds(env_kwargs: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Return arguments of a codec for which the actions cover the environment's yaws and workspace."""
    if env_kwargs.get("half_rotation") is False:
        yield "theta_bounds", list(WHOLE_TURN)
    match env_kwargs.get("workspace"):
        case [[int() | float() as low, int() | float() as high], *_]:
            yield "workspace_size", high - low


def _fit_image_size(hyperparams: dict[str, Any], overrides: Mapping[str, Any]) -> bool:
    """Give the encoder of a preset as many channels as the overridden ``obs_size`` needs halvings."""
    size = (_at(overrides, "env_kwargs") or {}).get("obs_size")
    encoder = _at(hyperparams, EXTRACTOR) or {}
    if type(size) is not int or size < 1 or "channels" not in encoder:
        return False
    if "channels" in (_at(overrides, EXTRACTOR) or {}):
        return False
    from sb3_extensions.encoders.cnn import count_halvings

    crop = (_at(hyperparams, "augmentation.rad") or {}).get("size", size)
    *halving, widest, last, features = before = encoder["channels"]
    missing = max(count_halvings(crop) - len(halving) - 1, 0)
    encoder["channels"] = [*halving, *[widest] * (missing + 1), last, features]
    return bool(encoder["channels"] != before)


def _at(mapping: Mapping[str, Any], name: str) -> dict[str, Any] | None:
    """Return the mapping at a dotted name, None if there is none."""
    found: Any = mapping
    for key in name.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, dict) else None
