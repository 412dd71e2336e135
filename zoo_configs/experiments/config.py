"""The hyperparameters of an experiment, from a baseline, a preset and an environment."""

import copy
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from zoo_configs.experiments.families import Layer, family_of
from zoo_configs.files import format_yaml

DEFAULT, OVERRIDES = Layer("default", {}), Layer("command line", {})
"""Sources of values that no configuration file defines."""
EXTRACTOR = "policy_kwargs.features_extractor_kwargs"


@dataclass(frozen=True)
class ExperimentConfig:
    """
    An experiment without its seed: everything that training needs.

    :param hyperparams: Hyperparameters, as in a section of rl_zoo3's YAML files; a dict or another mapping,
        such as OmegaConf's
    :param flags: Defaults for flags of ``train``, by option name
    :param baseline: The baseline, None for hyperparameters from elsewhere
    :param preset: The preset, None for hyperparameters from elsewhere
    :param benchmark: The benchmark that defines the task's parameters, None for another task
    :param overrides: Hyperparameters that replace those of the baseline
    :param sources: Layers that define the values, by dotted name such as ``hyperparams.gamma``
    """

    algo: str
    env_id: str
    hyperparams: dict[str, Any]
    flags: dict[str, Any] = field(default_factory=dict)
    baseline: str | None = None
    preset: str | None = None
    benchmark: str | None = None
    overrides: dict[str, Any] = field(default_factory=dict)
    sources: dict[str, Layer] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Convert values of other libraries, such as OmegaConf's lists, to plain data."""
        for name in ("hyperparams", "flags", "overrides"):
            object.__setattr__(self, name, plain(getattr(self, name)))

    @property
    def label(self) -> str:
        """Name for titles and tables: the baseline, or else the algorithm."""
        return self.baseline or self.algo

    def overridden(self, overrides: Mapping[str, Any]) -> "ExperimentConfig":
        """Return the experiment with hyperparameters that replace its own; mappings are merged."""
        sources = {name: OVERRIDES for name, _ in leaves({"hyperparams": overrides})}
        return replace(
            self,
            hyperparams=merge(self.hyperparams, overrides),
            overrides=merge(self.overrides, overrides),
            sources={**self.sources, **sources},
        )


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
    :param overrides: Hyperparameters that replace all others; mappings are merged
    :param benchmark: The benchmark that defines the task's parameters; None for the first that fits
    :raises CommandError: for an unknown name, or a benchmark without the task or the network
    """
    family = family_of(env_id)
    benchmark = family.benchmark_of(baseline, preset, env_id, benchmark)
    merged: dict[str, Any] = {"hyperparams": {}, "flags": {}}
    sources: dict[str, Layer] = {}
    for layer in family.layers(baseline, preset, env_id, benchmark):
        _merge_into(merged, layer.values)
        sources.update({name: layer for name, _ in leaves(layer.values)})
    names: dict[str, Any] = {"baseline": baseline, "preset": preset, "benchmark": benchmark}
    experiment = ExperimentConfig(**merged, env_id=env_id, **names, sources=sources).overridden(
        overrides or {}
    )
    for name, parameter in _follow_environment(experiment.hyperparams, experiment.overrides):
        experiment.sources[f"hyperparams.{name}"] = experiment.sources[f"hyperparams.env_kwargs.{parameter}"]
    return experiment


def leaves(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings with dotted names; an empty mapping is a value."""
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def plain(value: Any) -> Any:
    """Return mappings, sequences, paths, and NumPy's arrays and numbers as dicts, lists and plain values."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return (tuple if isinstance(value, tuple) else list)(map(plain, value))
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def merge(base: Mapping[str, Any], update: Mapping[str, Any]) -> dict[str, Any]:
    """Return two nested mappings merged; of the second, anything but a mapping replaces."""
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
    """Derive arguments of the policy from parameters, and yield the dotted name of both."""
    env_kwargs, policy_kwargs = _at(hyperparams, "env_kwargs"), _at(hyperparams, "policy_kwargs")
    if "action_sequence" in policy_kwargs and (sequence := env_kwargs.get("action_sequence")) is not None:
        policy_kwargs["action_sequence"] = sequence
        yield "policy_kwargs.action_sequence", "action_sequence"
    if _fit_image_size(hyperparams, overrides):
        yield f"{EXTRACTOR}.channels", "obs_size"


def _fit_image_size(hyperparams: dict[str, Any], overrides: Mapping[str, Any]) -> bool:
    """Give the encoder of a preset as many channels as the overridden ``obs_size`` needs halvings."""
    size, encoder = _at(overrides, "env_kwargs").get("obs_size"), _at(hyperparams, EXTRACTOR)
    if type(size) is not int or size < 1 or "channels" not in encoder:
        return False
    if "channels" in _at(overrides, EXTRACTOR):
        return False
    from sb3_extensions.encoders.cnn import count_halvings

    crop = _at(hyperparams, "augmentation.rad").get("size", size)
    *halving, widest, last, features = before = encoder["channels"]
    missing = max(count_halvings(crop) - len(halving) - 1, 0)
    encoder["channels"] = [*halving, *[widest] * (missing + 1), last, features]
    return bool(encoder["channels"] != before)


def look_up(mapping: Mapping[str, Any], name: str) -> Any:
    """Return the value at a dotted name, None if there is none."""
    found: Any = mapping
    for key in name.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _at(mapping: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the mapping at a dotted name, an empty one if there is none."""
    found = look_up(mapping, name)
    return found if isinstance(found, dict) else {}


def explained_yaml(experiment: ExperimentConfig, options: Mapping[str, Any], given: Mapping[str, Any]) -> str:
    """Return an experiment and options, some ``given`` by flags, as YAML with the source of each value."""
    sources = {"hyperparams": DEFAULT, "algo": OVERRIDES, "flags": DEFAULT, **experiment.sources}
    sources.update({f"flags.{name}": OVERRIDES for name in given})
    lines = [_line("algo", experiment.algo, sources["algo"]), f"{experiment.env_id}:"]
    lines += _lines(experiment.hyperparams, "hyperparams", sources)
    return "\n".join([*lines, "options:", *_lines(options, "flags", sources)])


def _lines(
    values: Mapping[str, Any], name: str, sources: Mapping[str, Layer], indent: str = "  "
) -> Iterator[str]:
    for key, value in values.items():
        inner = f"{name}.{key}"
        if isinstance(value, Mapping) and value:
            yield f"{indent}{key}:"
            yield from _lines(value, inner, sources, f"{indent}  ")
            continue
        while inner not in sources:  # a mapping around the value has the source
            inner = inner.rpartition(".")[0]
        yield indent + _line(key, value, sources[inner])


def _line(key: str, value: Any, layer: Layer) -> str:
    text = f"{format_yaml({key: value}, inline=True)[1:-1]}  # {layer.source}"
    return f"{text}: {layer.why}" if layer.why else text
