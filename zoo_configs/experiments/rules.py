"""Configuration files: baselines, presets, and the layers of hyperparameters of an experiment."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib import resources
from typing import Any, NamedTuple

from zoo_configs.algorithms import ALGORITHMS
from zoo_configs.errors import CommandError, check_names, refused
from zoo_configs.yaml_files import parse_yaml

AXES = ("benchmarks", "networks", "learners", "additions", "tasks")
"""Keys below which a section has sections by name, in the order of merging."""
VALUE_KEYS = ("why", "algo", "set", "flags")
FAMILY_KEYS = ("envs", "serves", "baselines", "product", "algorithms", "defaults", *AXES, "presets")
FLAGS = ("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "vec_env", "log_interval")
"""Flags of ``train`` for which a section can define a default."""
NO_BENCHMARK = "none"


class Baseline(NamedTuple):
    """
    A baseline of the benchmarks.

    :param learner: The learner, for example ``"sacfd"``
    :param network: The network, for example ``"equivariant"``
    :param additions: Additions, for example augmentations
    """

    learner: str
    network: str
    additions: tuple[str, ...] = ()


class Case(NamedTuple):
    """
    The names that select the layers of an experiment.

    :param preset: The preset
    :param env_id: Id of the environment
    :param benchmark: The benchmark that defines the task's parameters, None for another task
    :param baseline: The baseline
    """

    preset: str
    env_id: str
    benchmark: str | None
    baseline: Baseline

    def names(self, axis: str) -> tuple[str, ...]:
        """
        Return the names on an axis.

        :param axis: One of ``AXES``
        """
        names: dict[str, tuple[str, ...]] = {
            "benchmarks": (self.benchmark or NO_BENCHMARK,),
            "networks": (self.baseline.network,),
            "learners": (self.baseline.learner,),
            "additions": self.baseline.additions,
            "tasks": (task_name(self.env_id),),
        }
        return names[axis]


@dataclass(frozen=True)
class Layer:
    """
    Values of one section of a configuration file.

    :param source: The file and the section
    :param why: The reason, or the source of the numbers
    :param algo: Name of the algorithm, None if another layer defines it
    :param hyperparams: Hyperparameters; mappings are merged with those of earlier layers
    :param flags: Defaults for flags of ``train``
    """

    source: str
    why: str = ""
    algo: str | None = None
    hyperparams: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Family:
    """
    One configuration file: baselines and presets of a family of environments.

    :param name: Name of the file without its suffix
    :param envs: Shell pattern of the ids
    :param benchmarks: Networks by benchmark; without a choice, the first benchmark with the task applies
    :param baselines: Baselines by name
    :param algorithms: Baselines for an algorithm without one of its name; the first for the task applies
    :param sections: The sections by key
    """

    name: str
    envs: str
    benchmarks: Mapping[str, tuple[str, ...]]
    baselines: Mapping[str, Baseline]
    algorithms: Mapping[str, tuple[str, ...]]
    sections: Mapping[str, Any]

    @property
    def presets(self) -> tuple[str, ...]:
        """Names of the presets."""
        return tuple(self.sections["presets"])

    def serves(self, env_id: str) -> bool:
        """
        Return True if the family has hyperparameters for an environment.

        :param env_id: Id of the environment
        """
        return fnmatchcase(env_id, self.envs)

    def layers(self, case: Case, benchmark: Iterable[Layer] = ()) -> Iterator[Layer]:
        """
        Return the layers of an experiment in the order of merging.

        :param case: The experiment
        :param benchmark: Layers of the task's benchmark
        """
        yield Layer("name of the baseline", algo=case.baseline.learner)
        yield from _layers(self.sections.get("defaults", {}), case, f"{self.name}.yml, defaults")
        yield from benchmark
        yield from _layers({axis: self.sections.get(axis, {}) for axis in AXES}, case, f"{self.name}.yml, ")
        preset = self.sections["presets"][case.preset]
        yield from _layers(preset, case, f"{self.name}.yml, presets.{case.preset}")


def _layers(section: Any, case: Case, source: str) -> Iterator[Layer]:
    """Return the layers of a section, or of a list of sections, in the order of merging."""
    if isinstance(section, list):
        for part in section:
            yield from _layers(part, case, source)
        return
    if section.keys() & {"algo", "set", "flags"}:
        why = " ".join(section.get("why", "").split())
        yield Layer(source, why, section.get("algo"), section.get("set", {}), section.get("flags", {}))
    for axis in AXES:
        for name in case.names(axis):
            if name in section.get(axis, {}):
                inner = f"{source}.{axis}.{name}".replace(", .", ", ")
                yield from _layers(section[axis][name], case, inner)


def task_name(env_id: str) -> str:
    """
    Return an id without its namespace and version.

    :param env_id: ``"BulletArm/CloseLoopBlockPicking-v0"``
    :return: ``"CloseLoopBlockPicking"``
    """
    return env_id.rpartition("/")[2].partition("-v")[0]


@functools.cache
def families() -> tuple[Family, ...]:
    """
    Load all configuration files.

    :return: The families in the order of their file names
    :raises CommandError: for an unknown key or name in a file
    """
    folder = resources.files("zoo_configs") / "hyperparams"
    texts = {
        file.name: file.read_text(encoding="utf-8") for file in folder.iterdir() if file.name.endswith(".yml")
    }
    return tuple(parse_family(name.removesuffix(".yml"), texts[name]) for name in sorted(texts))


def family_of(env_id: str) -> Family:
    """
    Return the family of an environment.

    :param env_id: Id of the environment
    :raises CommandError: if it has no baselines
    """
    for family in families():
        if family.serves(env_id):
            return family
    patterns = ", ".join(family.envs for family in families())
    raise CommandError(f"no baselines for {env_id!r}, only for {patterns}. Use --algo and --conf-file.")


def parse_family(name: str, text: str) -> Family:
    """
    Parse a configuration file.

    :param name: Name of the file without its suffix
    :param text: Its content
    :return: The family
    :raises CommandError: for an unknown key or name
    """
    file = f"{name}.yml"
    with refused(f"{file} cannot be read"):
        data = parse_yaml(text)
    check_names(f"key of {file}", data, FAMILY_KEYS)
    baselines = {**_products(data.get("product", {})), **_baselines(file, data.get("baselines", {}))}
    benchmarks = {key: tuple(networks) for key, networks in data.get("serves", {}).items()}
    algorithms = _algorithms(file, data.get("algorithms", {}), baselines)
    sections = {key: data[key] for key in ("defaults", *AXES, "presets") if key in data}
    family = Family(name, data["envs"], benchmarks, baselines, algorithms, sections)
    _check_sections(family)
    return family


def _products(product: Mapping[str, Any]) -> dict[str, Baseline]:
    pairs = itertools.product(product.get("learners", ()), product.get("networks", ()))
    return {f"{learner}_{network}": Baseline(learner, network) for learner, network in pairs}


def _baselines(file: str, given: Mapping[str, Any]) -> dict[str, Baseline]:
    for name, parts in given.items():
        if not isinstance(parts, list) or len(parts) < 2:
            raise CommandError(f"{name!r} of {file} must be [learner, network, additions], got {parts!r}")
    return {
        name: Baseline(learner, network, tuple(rest)) for name, (learner, network, *rest) in given.items()
    }


def _algorithms(
    file: str, given: Mapping[str, Any], baselines: Mapping[str, Baseline]
) -> dict[str, tuple[str, ...]]:
    check_names(f"algorithm of {file}", given, ALGORITHMS)
    algorithms = {key: (names,) if isinstance(names, str) else tuple(names) for key, names in given.items()}
    for algo, names in algorithms.items():
        check_names(f"baseline of {file}, algorithm {algo}", names, baselines)
    return algorithms


def _check_sections(family: Family) -> None:
    """
    Check the keys of all sections, and the names below them. Any name of a task is valid.

    :raises CommandError: for an unknown key or name
    """
    baselines = family.baselines.values()
    valid = {
        "benchmarks": {*family.benchmarks, NO_BENCHMARK},
        "networks": {baseline.network for baseline in baselines},
        "learners": {baseline.learner for baseline in baselines},
        "additions": {addition for baseline in baselines for addition in baseline.additions},
    }

    def check(section: Any, where: str) -> None:
        if isinstance(section, list):
            for part in section:
                check(part, where)
            return
        check_names(f"key of {where}", section, (*VALUE_KEYS, *AXES))
        check_names(f"flag of {where}", section.get("flags", {}), FLAGS)
        for axis in AXES:
            for name, inner in section.get(axis, {}).items():
                check_names(f"name of {where}.{axis}", [name], valid.get(axis, {name}))
                check(inner, f"{where}.{axis}.{name}")

    check(family.sections.get("defaults", {}), f"{family.name}.yml, defaults")
    check({axis: family.sections.get(axis, {}) for axis in AXES}, f"{family.name}.yml")
    for preset, section in family.sections["presets"].items():
        check(section, f"{family.name}.yml, presets.{preset}")
