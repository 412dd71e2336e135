"""From the name of a baseline, a preset and an environment to one set of hyperparameters."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib import resources
from typing import Any

import yaml

from zoo_configs.benchmarks import choose_benchmark, task_parameters
from zoo_configs.errors import CommandError, unknown_name

FAMILY_KEYS = ("envs", "benchmarks", "hyperparams", "presets", "learners", "baselines", "tasks")
PRESET_KEYS = ("flags", "hyperparams", "policies", "baselines")
BASELINE_KEYS = ("algo", "policy", "hyperparams")
LEARNER_KEYS = ("algo", "hyperparams")
# Flags of rl_zoo3.train for which a preset may choose the default.
PRESET_FLAGS = ("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "vec_env", "log_interval")


@dataclass(frozen=True)
class Cell:
    """
    One cell of a benchmark: everything rl_zoo3 needs to train one agent.

    :param algo: Name of the algorithm's class in rl_zoo3's table
    :param env_id: Id of the environment
    :param hyperparams: The section of rl_zoo3's YAML for this environment
    :param flags: Defaults for flags of ``rl_zoo3.train``, named as in its namespace
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

    @property
    def label(self) -> str:
        """Name for titles and tables: the baseline, or else the algorithm."""
        return self.baseline or self.algo


@dataclass(frozen=True)
class Family:
    """
    One file of hyperparameters: the baselines and presets of a family of environments.

    Layers, later ones win: family, benchmark, preset, policy of the preset, baseline, baseline of the preset;
    then hyperparameters, policy and baseline of what the task says of the preset.

    :param name: Name of the file without its suffix
    :param envs: Shell pattern of the ids it serves
    :param benchmarks: From benchmark to the policies that serve it; a task is trained as in the first that
        has it and the policy, unless another is named
    :param hyperparams: What all cells share
    :param presets: From preset to its flags, its hyperparameters, and those of policies and baselines in it
    :param baselines: From baseline to its algorithm, the name of its policy and its hyperparameters
    :param tasks: From id to preset to what is special about them, laid out as a preset
    """

    name: str
    envs: str
    benchmarks: dict[str, list[str]]
    hyperparams: dict[str, Any]
    presets: dict[str, dict[str, Any]]
    baselines: dict[str, dict[str, Any]]
    tasks: dict[str, dict[str, dict[str, Any]]]

    def serves(self, env_id: str) -> bool:
        """Whether the family has hyperparameters for an id."""
        return fnmatchcase(env_id, self.envs)


@functools.cache
def families() -> tuple[Family, ...]:
    """
    Load all files of hyperparameters.

    :return: The families in order of their file names
    :raises CommandError: if a file has a key that means nothing
    """
    folder = resources.files("zoo_configs") / "hyperparams"
    texts = {
        file.name: file.read_text(encoding="utf-8") for file in folder.iterdir() if file.name.endswith(".yml")
    }
    return tuple(parse_family(name.removesuffix(".yml"), texts[name]) for name in sorted(texts))


def family_of(env_id: str) -> Family:
    """
    The family that serves an environment.

    :param env_id: Id of the environment
    :return: The family
    :raises CommandError: if no baselines exist for it
    """
    for family in families():
        if family.serves(env_id):
            return family
    served = ", ".join(family.envs for family in families())
    raise CommandError(f"no baselines for {env_id!r}, only for {served}; use --algo and --conf-file")


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
    :param overrides: Hyperparameters that win over all layers; mappings are merged, other values replaced
    :param benchmark: Benchmark whose parameters the task has; None takes the first that fits
    :return: The cell, its hyperparameters not shared with any other
    :raises CommandError: for an unknown name, naming the nearest valid one, or a benchmark that does not have
        the task or the network
    """
    family = family_of(env_id)
    row = _entry("baseline", baseline, family.baselines)
    size = _entry("preset", preset, family.presets)
    policy = _entry(f"policy of preset {preset}", row["policy"], size["policies"])
    task = family.tasks.get(env_id, {}).get(preset, {})
    chosen = choose_benchmark(family.benchmarks, env_id, row["policy"], benchmark)
    layers = (
        family.hyperparams,
        {} if chosen is None else task_parameters(chosen, env_id),
        size.get("hyperparams", {}),
        policy,
        row.get("hyperparams", {}),
        size.get("baselines", {}).get(baseline, {}),
        task.get("hyperparams", {}),
        task.get("policies", {}).get(row["policy"], {}),
        task.get("baselines", {}).get(baseline, {}),
        overrides or {},
    )
    hyperparams: dict[str, Any] = {}
    for layer in layers:
        hyperparams = merge(hyperparams, layer)
    _share_action_sequence(hyperparams)
    flags = merge(size.get("flags", {}), task.get("flags", {}))
    return Cell(row["algo"], env_id, hyperparams, flags, baseline, preset, chosen)


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
    for key in ("policy_kwargs", "replay_buffer_kwargs"):
        kwargs = hyperparams.get(key, {})
        if isinstance(kwargs, dict) and "action_sequence" in kwargs and sequence is not None:
            kwargs["action_sequence"] = sequence


def _entry(kind: str, name: str, table: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    if name not in table:
        raise unknown_name(kind, name, table)
    return table[name]


def parse_family(name: str, text: str) -> Family:
    """
    Read a file of hyperparameters.

    :param name: Name of the file without its suffix
    :param text: What it says, in YAML
    :return: The family
    :raises CommandError: if a key means nothing; names the nearest one that does
    """
    data = yaml.safe_load(text)
    where = f"hyperparams/{name}.yml"
    _check_keys(f"key of {where}", data, FAMILY_KEYS)
    for learner in data.get("learners", {}).values():
        _check_keys(f"learner key of {where}", learner, LEARNER_KEYS)
    data["baselines"] = {**_products(data), **data.get("baselines", {})}
    for baseline in data["baselines"].values():
        _check_keys(f"baseline key of {where}", baseline, BASELINE_KEYS)
    presets = data["presets"]
    sections = list(presets.items())
    for task in data.get("tasks", {}).values():
        _check_keys(f"preset of a task of {where}", task, presets)
        sections += task.items()
    for name_of_preset, section in sections:
        _check_section(where, section, data["baselines"], presets[name_of_preset]["policies"])
    keys = (key for key in FAMILY_KEYS if key != "learners")  # they are in the baselines
    return Family(name=name, **{key: data.get(key, {}) for key in keys})


def _products(data: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """A baseline of every learner on every network."""
    networks = dict.fromkeys(name for preset in data["presets"].values() for name in preset["policies"])
    return {
        f"{name}_{network}": {**learner, "policy": network}
        for name, learner in data.get("learners", {}).items()
        for network in networks
    }


def _check_section(
    where: str, section: Mapping[str, Any], baselines: Mapping[str, Any], policies: Mapping[str, Any]
) -> None:
    """Check the keys of a preset, or of what a task says of a preset."""
    _check_keys(f"preset key of {where}", section, PRESET_KEYS)
    _check_keys(f"flag of {where}", section.get("flags", {}), PRESET_FLAGS)
    _check_keys(f"policy of {where}", section.get("policies", {}), policies)
    _check_keys(f"baseline of a preset of {where}", section.get("baselines", {}), baselines)


def _check_keys(kind: str, mapping: Mapping[str, Any], valid: Mapping[str, Any] | tuple[str, ...]) -> None:
    for key in mapping:
        if key not in valid:
            raise unknown_name(kind, key, valid)
