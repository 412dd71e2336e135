"""Configuration files: baselines, presets, and the layers of hyperparameters of an experiment."""

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib import resources
from typing import Any, NamedTuple

from bulletarm_gym.benchmarks import BENCHMARKS
from zoo_configs.errors import CommandError, check_names, unknown_name
from zoo_configs.files import parse_yaml

AXES = ("benchmarks", "networks", "learners", "additions", "tasks")
"""Keys below which a section has sections by name, in the order of merging."""
SECTION_KEYS = ("why", "algo", "set", "flags", *AXES)
NO_BENCHMARK = "none"


class Baseline(NamedTuple):
    """A baseline of the benchmarks: learner, network and additions, for example augmentations."""

    learner: str
    network: str
    additions: tuple[str, ...] = ()


class Case(NamedTuple):
    """The names that select the layers of an experiment; the benchmark is None for other tasks."""

    preset: str
    env_id: str
    benchmark: str | None
    baseline: Baseline

    def names(self, axis: str) -> tuple[str, ...]:
        """Return the names on one of ``AXES``."""
        baseline = self.baseline
        benchmark, task = self.benchmark or NO_BENCHMARK, task_name(self.env_id)
        names = ((benchmark,), (baseline.network,), (baseline.learner,), baseline.additions, (task,))
        return dict(zip(AXES, names, strict=True))[axis]


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
    benchmarks: Mapping[str, Sequence[str]]
    baselines: Mapping[str, Baseline]
    algorithms: Mapping[str, Sequence[str]]
    sections: Mapping[str, Any]

    @property
    def presets(self) -> tuple[str, ...]:
        """Names of the presets."""
        return tuple(self.sections["presets"])

    def has_env(self, env_id: str) -> bool:
        """Return True if the family has hyperparameters for an environment."""
        return fnmatchcase(env_id, self.envs)

    def has_experiment(self, baseline: str, env_id: str, benchmark: str | None = None) -> bool:
        """Return True if a baseline serves a task in a benchmark, None for any. All serve other tasks."""
        network, with_task = self.baselines[baseline].network, self._benchmarks_of(env_id)
        chosen = [name for name in with_task if benchmark in (None, name)]
        return not with_task or any(network in self.benchmarks[name] for name in chosen)

    def case(self, baseline: str, preset: str, env_id: str, benchmark: str | None = None) -> Case:
        """Return the names of an experiment; raise ``CommandError`` if one is unknown or does not fit."""
        named = [("baseline", baseline, self.baselines), ("preset", preset, self.presets)]
        if benchmark is not None:
            named.append(("benchmark", benchmark, BENCHMARKS))
        for kind, name, valid in named:
            if name not in valid:
                others = [
                    family.envs for family in families() if name in (*family.baselines, *family.presets)
                ]
                if others:
                    raise CommandError(f"{kind} {name!r} is for {' or '.join(others)}, not for {env_id}")
                raise unknown_name(kind, name, valid)
        parts = self.baselines[baseline]
        return Case(preset, env_id, self._choose(parts.network, env_id, benchmark), parts)

    def _choose(self, network: str, env_id: str, wanted: str | None) -> str | None:
        """Return the benchmark that defines a task's parameters, None for a task of no benchmark."""
        with_task = self._benchmarks_of(env_id)
        if wanted is not None and wanted not in with_task:
            names = ", ".join(with_task) or "none"
            raise CommandError(f"benchmark must be one of those with {env_id} ({names}), got {wanted!r}")
        networks = {name: self.benchmarks[name] for name in with_task if wanted in (None, name)}
        fitting = [name for name, valid in networks.items() if network in valid]
        if with_task and not fitting:
            raise CommandError(
                f"network {network!r} does not fit {env_id}. Networks by benchmark: {networks}"
            )
        return fitting[0] if fitting else None

    def _benchmarks_of(self, env_id: str) -> list[str]:
        ids = {name: {row.env_id for row in BENCHMARKS[name].environments} for name in self.benchmarks}
        return [name for name in self.benchmarks if env_id in ids[name]]

    def layers(self, case: Case) -> Iterator[Layer]:
        """Yield the layers of an experiment in the order of merging."""
        yield Layer("name of the baseline", algo=case.baseline.learner)
        yield from _layers(self.sections.get("defaults", {}), case, f"{self.name}.yml, defaults")
        if case.benchmark is not None:
            table = BENCHMARKS[case.benchmark]
            [row] = (environment for environment in table.environments if environment.env_id == case.env_id)
            values = {"env_kwargs": table.make_kwargs(row), "expert_episodes": row.expert_episodes}
            yield Layer(f"bulletarm_gym.benchmarks, {case.benchmark}", hyperparams=values)
        yield from _layers({axis: self.sections.get(axis, {}) for axis in AXES}, case, f"{self.name}.yml, ")
        preset = self.sections["presets"][case.preset]
        yield from _layers(preset, case, f"{self.name}.yml, presets.{case.preset}")


def _layers(section: Any, case: Case, source: str) -> Iterator[Layer]:
    """Return the layers of a section, or of a list of sections, in the order of merging."""
    if isinstance(section, list):
        for part in section:
            yield from _layers(part, case, source)
        return
    check_names(f"key of {source}", section, SECTION_KEYS)
    if section.keys() & {"algo", "set", "flags"}:
        why = " ".join(section.get("why", "").split())
        yield Layer(source, why, section.get("algo"), section.get("set", {}), section.get("flags", {}))
    for axis in AXES:
        for name in case.names(axis):
            if name in section.get(axis, {}):
                inner = f"{source}.{axis}.{name}".replace(", .", ", ")
                yield from _layers(section[axis][name], case, inner)


def task_name(env_id: str) -> str:
    """Return an id without its namespace and version, such as ``"CloseLoopBlockPicking"``."""
    return env_id.rpartition("/")[2].partition("-v")[0]


@functools.cache
def families() -> tuple[Family, ...]:
    """Load all configuration files, in the order of their names."""
    folder = resources.files("zoo_configs") / "hyperparams"
    files = sorted(
        (file for file in folder.iterdir() if file.name.endswith(".yml")), key=lambda file: file.name
    )
    return tuple(parse_family(file.name[:-4], file.read_text(encoding="utf-8")) for file in files)


def family_of(env_id: str) -> Family:
    """Return the family of an environment; raise ``CommandError`` if it has no baselines."""
    for family in families():
        if family.has_env(env_id):
            return family
    patterns = ", ".join(family.envs for family in families())
    raise CommandError(f"no baselines for {env_id!r}, only for {patterns}. Use --algo and --conf-file.")


def parse_family(name: str, text: str) -> Family:
    """Parse the text of a configuration file."""
    data = parse_yaml(text)
    product = data.get("product", {"learners": (), "networks": ()})
    pairs = itertools.product(product["learners"], product["networks"])
    baselines = {f"{learner}_{network}": Baseline(learner, network) for learner, network in pairs}
    for label, (learner, network, *additions) in data.get("baselines", {}).items():
        baselines[label] = Baseline(learner, network, tuple(additions))
    return Family(name, data["envs"], data.get("serves", {}), baselines, data.get("algorithms", {}), data)
