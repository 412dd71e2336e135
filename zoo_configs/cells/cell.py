"""From the name of a baseline, a preset and an environment to one set of hyperparameters."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from zoo_configs.cells.benchmarks import choose_benchmark, task_parameters
from zoo_configs.cells.rules import Case, Family, Rule, families, family_of
from zoo_configs.errors import CommandError, unknown_name

OVERRIDES = "overrides"
FOLLOWING = ("policy_kwargs",)
"""Arguments whose action sequence follows the environment's."""
GRID = "policy_kwargs.codec_kwargs"
# Arguments of a codec, and the environment's parameter that each follows.
GRID_FOLLOWS = {"theta_bounds": "half_rotation", "workspace_size": "workspace"}
EXTRACTOR = "policy_kwargs.features_extractor_kwargs"
CHANNELS = f"{EXTRACTOR}.channels"
"""Argument of an encoder that follows the size of the image."""
WHOLE_TURN = (-math.pi, math.pi)  # rad, what -1 and 1 stand for without half_rotation


@dataclass(frozen=True)
class Cell:
    """
    One cell of a benchmark: everything rl_zoo3 needs to train one agent.

    :param algo: Name of the algorithm's class in rl_zoo3's table
    :param env_id: Id of the environment
    :param hyperparams: The section of rl_zoo3's YAML for this environment
    :param flags: Defaults for flags of ``rl_zoo3.train``, named as in its namespace
    :param overrides: Hyperparameters that replace those of the baseline
    :param baseline: The row of the benchmark, None for hyperparameters from elsewhere
    :param preset: The size of the run, None for hyperparameters from elsewhere
    :param benchmark: The benchmark whose parameters the task has, None for a task of none
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
) -> Cell:
    """
    Look up the hyperparameters of one cell.

    :param baseline: Row of a benchmark, for example ``"equi_sacfd"``
    :param preset: ``"cpu"`` or ``"paper"``
    :param env_id: Id of the environment
    :param overrides: Hyperparameters that win over all rules; mappings are merged, other values replaced
    :param benchmark: Benchmark whose parameters the task has; None takes the first that fits
    :return: The cell, its hyperparameters not shared with any other
    :raises CommandError: for an unknown name, naming the nearest valid one, or a benchmark that does not have
        the task or the network
    """
    case, rules = _applied(baseline, preset, env_id, overrides, benchmark)
    hyperparams: dict[str, Any] = {}
    flags: dict[str, Any] = {}
    for rule in rules:
        hyperparams, flags = merge(hyperparams, rule.hyperparams), merge(flags, rule.flags)
    _share_action_sequence(hyperparams)
    _share_bounds(hyperparams)
    _fit_image_size(hyperparams, overrides or {})
    algo = next(rule.algo for rule in reversed(rules) if rule.algo is not None)
    kept = copy.deepcopy(dict(overrides or {}))
    return Cell(algo, env_id, hyperparams, flags, baseline, preset, case.benchmark, kept)


def explain(
    baseline: str,
    preset: str,
    env_id: str,
    overrides: Mapping[str, Any] | None = None,
    benchmark: str | None = None,
) -> list[tuple[Rule, dict[str, Any]]]:
    """
    Tell where the values of a cell come from.

    :param baseline: As for :func:`resolve`
    :param preset: As for :func:`resolve`
    :param env_id: As for :func:`resolve`
    :param overrides: As for :func:`resolve`
    :param benchmark: As for :func:`resolve`
    :return: The rules that hold, in their order, each with the values that it set and no later one changed;
        names with dots lead into mappings
    :raises CommandError: as :func:`resolve`
    """
    cell = resolve(baseline, preset, env_id, overrides, benchmark)
    _, rules = _applied(baseline, preset, env_id, overrides, benchmark)
    sources = {}
    for rule in rules:
        sources.update({name: rule for name, _ in _leaves(_said(rule.algo, rule.hyperparams, rule.flags))})
    for follower in (f"{key}.action_sequence" for key in FOLLOWING):
        if follower in sources:
            sources[follower] = sources.get("env_kwargs.action_sequence", sources[follower])
    for argument, parameter in GRID_FOLLOWS.items():
        if f"env_kwargs.{parameter}" in sources:
            sources.setdefault(f"{GRID}.{argument}", sources[f"env_kwargs.{parameter}"])
    said = dict(_leaves(_said(cell.algo, cell.hyperparams, cell.flags)))
    if CHANNELS in sources and dict(_leaves(sources[CHANNELS].hyperparams))[CHANNELS] != said[CHANNELS]:
        sources[CHANNELS] = sources["env_kwargs.obs_size"]
    kept = [(rule, {name: said[name] for name in said if sources[name] is rule}) for rule in rules]
    return [(rule, values) for rule, values in kept if values]


def _said(algo: str | None, hyperparams: Mapping[str, Any], flags: Mapping[str, Any]) -> dict[str, Any]:
    """All that a rule or a cell says, without what it leaves open."""
    return {
        **({} if algo is None else {"algo": algo}),
        **hyperparams,
        **({"flags": flags} if flags else {}),
    }


def _applied(
    baseline: str,
    preset: str,
    env_id: str,
    overrides: Mapping[str, Any] | None,
    benchmark: str | None,
) -> tuple[Case, list[Rule]]:
    """The case, and the rules that hold in it, in their order."""
    family = family_of(env_id)
    case = _case(family, baseline, preset, env_id, benchmark)
    rules = [rule for rule in family.rules if rule.holds(case)]
    if case.benchmark is not None:
        where = f"bulletarm_gym.benchmarks: {case.benchmark}"
        rules.insert(0, Rule(where, hyperparams=task_parameters(case.benchmark, env_id)))
    rules.insert(0, Rule("name of the baseline", algo=case.baseline.learner))
    return case, [*rules, Rule(OVERRIDES, hyperparams=overrides or {})]


def _case(family: Family, baseline: str, preset: str, env_id: str, benchmark: str | None) -> Case:
    if baseline not in family.baselines:
        if others := [other.envs for other in families() if baseline in other.baselines]:
            raise CommandError(f"baseline {baseline!r} is for {' or '.join(others)}, not for {env_id}")
        raise unknown_name("baseline", baseline, family.baselines)
    _check_preset(family, preset, env_id)
    row = family.baselines[baseline]
    chosen = choose_benchmark(family.benchmarks, env_id, row.network, benchmark)
    return Case(preset, env_id, chosen, row)


def _check_preset(family: Family, preset: str, env_id: str) -> None:
    if preset in family.presets:
        return
    if others := [other.envs for other in families() if preset in other.presets]:
        valid = ", ".join(sorted(family.presets))
        whose = " or ".join(others)
        raise CommandError(f"preset {preset!r} is for {whose}, not for {env_id}: choose from {valid}")
    raise unknown_name("preset", preset, family.presets)


def _leaves(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Values with dotted names; a mapping of nothing is a value, too."""
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def merge(base: Mapping[str, Any], update: Mapping[str, Any]) -> dict[str, Any]:
    """
    Merge two nested mappings.

    :param base: The values below
    :param update: The values on top; a mapping on a mapping is merged, anything else replaces
    :return: A new mapping that shares nothing with the two
    """
    merged = copy.deepcopy(dict(base))
    for key, value in update.items():
        below = merged.get(key)
        both = isinstance(below, Mapping) and isinstance(value, Mapping)
        merged[key] = merge(below, value) if both else copy.deepcopy(value)  # type: ignore[arg-type]
    return merged


def _share_action_sequence(hyperparams: dict[str, Any]) -> None:
    """What turns with the scene must know which numbers are dx and dy: the environment's sequence says so."""
    sequence = hyperparams.get("env_kwargs", {}).get("action_sequence")
    for key in FOLLOWING:
        kwargs = hyperparams.get(key, {})
        if isinstance(kwargs, dict) and "action_sequence" in kwargs and sequence is not None:
            kwargs["action_sequence"] = sequence


def _share_bounds(hyperparams: dict[str, Any]) -> None:
    """A grid of actions lies over what the environment's range over, unless it is told otherwise."""
    codec_kwargs: Any = _at(hyperparams, GRID)
    if codec_kwargs is None:
        return
    env_kwargs = hyperparams.get("env_kwargs", {})
    if env_kwargs.get("half_rotation") is False:
        codec_kwargs.setdefault("theta_bounds", list(WHOLE_TURN))
    match env_kwargs.get("workspace"):
        case [[int() | float() as low, int() | float() as high], *_]:
            codec_kwargs.setdefault("workspace_size", high - low)


def _fit_image_size(hyperparams: dict[str, Any], overrides: Mapping[str, Any]) -> None:
    """Fit a preset's encoder to the ``obs_size`` of the overrides: more halvings for a larger image."""
    size = (_at(overrides, "env_kwargs") or {}).get("obs_size")
    encoder = _at(hyperparams, EXTRACTOR)
    if type(size) is not int or size < 1 or encoder is None:
        return
    from sb3_extensions.encoders.cnn import count_halvings

    rad = _at(hyperparams, "augmentation.rad") or {}
    halvings = count_halvings(rad.get("size", size))
    if "channels" in encoder and "channels" not in (_at(overrides, EXTRACTOR) or {}):
        *halving, widest, last, features = encoder["channels"]
        missing = max(halvings - len(halving) - 1, 0)
        encoder["channels"] = [*halving, *[widest] * (missing + 1), last, features]


def _at(mapping: Mapping[str, Any], name: str) -> Any:
    """Return the mapping at a dotted name, None if there is none."""
    found: Any = mapping
    for key in name.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else None
