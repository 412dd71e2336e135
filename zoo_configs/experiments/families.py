"""Configuration files: baselines, presets, and the layers of hyperparameters of an experiment."""

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

from bulletarm_gym.benchmarks import BENCHMARKS
from zoo_configs.errors import CommandError, check_names
from zoo_configs.files import parse_yaml

AXES = ("benchmarks", "networks", "learners", "additions", "tasks")
"""Keys below which a section has sections by name, in the order of merging."""
VALUE_KEYS = {"algo": "algo", "hyperparams": "set", "flags": "flags"}
"""Keys of a section's values."""


class Baseline(NamedTuple):
    """A baseline of the benchmarks: learner, network and additions, for example augmentations."""

    learner: str
    network: str
    additions: tuple[str, ...] = ()


class Layer(NamedTuple):
    """``algo``, ``hyperparams`` and ``flags`` of a section of a file, and why they have these values."""

    source: str
    values: Mapping[str, Any]
    why: str = ""


@dataclass(frozen=True)
class Family:
    """
    One configuration file: baselines and presets of a family of environments.

    :param name: Name of the file without its suffix
    :param envs: Shell pattern of the ids
    :param benchmarks: Networks by benchmark; without a choice, the first benchmark with the task applies
    :param algorithms: Baselines for an algorithm without one of its name; the first for the task applies
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
        return not self._networks(env_id) or bool(self._fitting(baseline, env_id, benchmark))

    def benchmark_of(self, baseline: str, preset: str, env_id: str, wanted: str | None = None) -> str | None:
        """Return the benchmark of a task's parameters, if any; raise ``CommandError`` if names do not fit."""
        for kind, name, valid in (("baseline", baseline, self.baselines), ("preset", preset, self.presets)):
            others = [family.envs for family in families() if name in (*family.baselines, *family.presets)]
            if name not in valid and others:
                raise CommandError(f"{kind} {name!r} is for {' or '.join(others)}, not for {env_id}")
            check_names(kind, [name], valid)
        check_names("benchmark", filter(None, [wanted]), BENCHMARKS)
        networks, fitting = self._networks(env_id), self._fitting(baseline, env_id, wanted)
        if wanted is not None and wanted not in networks:
            names = ", ".join(networks) or "none"
            raise CommandError(f"benchmark must be one of those with {env_id} ({names}), got {wanted!r}")
        if networks and not fitting:
            network = self.baselines[baseline].network
            raise CommandError(
                f"network {network!r} does not fit {env_id}. Networks by benchmark: {networks}"
            )
        return fitting[0] if fitting else None

    def _fitting(self, baseline: str, env_id: str, wanted: str | None) -> list[str]:
        """Return the benchmarks, None for any, in which a baseline serves a task."""
        network, networks = self.baselines[baseline].network, self._networks(env_id)
        return [name for name in networks if network in networks[name] and wanted in (None, name)]

    def _networks(self, env_id: str) -> dict[str, Sequence[str]]:
        """Return the networks by benchmark with a task."""
        ids = {name: {row.env_id for row in BENCHMARKS[name].environments} for name in self.benchmarks}
        return {name: networks for name, networks in self.benchmarks.items() if env_id in ids[name]}

    def layers(self, baseline: str, preset: str, env_id: str, benchmark: str | None) -> Iterator[Layer]:
        """Yield the layers of an experiment in the order of merging."""
        learner, network, additions = self.baselines[baseline]
        names = ((benchmark or "none",), (network,), (learner,), additions, (task_name(env_id),))
        yield Layer("name of the baseline", {"algo": learner})
        yield from _layers(self.sections.get("defaults", {}), names, f"{self.name}.yml, defaults")
        if benchmark is not None:
            table = BENCHMARKS[benchmark]
            [row] = (environment for environment in table.environments if environment.env_id == env_id)
            values = {"env_kwargs": table.make_kwargs(row), "expert_episodes": row.expert_episodes}
            yield Layer(f"bulletarm_gym.benchmarks, {benchmark}", {"hyperparams": values})
        yield from _layers({axis: self.sections.get(axis, {}) for axis in AXES}, names, f"{self.name}.yml, ")
        section = self.sections["presets"][preset]
        yield from _layers(section, names, f"{self.name}.yml, presets.{preset}")


def _layers(section: Any, names: Sequence[Sequence[str]], source: str) -> Iterator[Layer]:
    """Yield the layers of a section, or of a list of sections; ``names`` are those on each of ``AXES``."""
    if isinstance(section, list):
        for part in section:
            yield from _layers(part, names, source)
        return
    check_names(f"key of {source}", section, ("why", *VALUE_KEYS.values(), *AXES))
    if values := {name: section[key] for name, key in VALUE_KEYS.items() if key in section}:
        yield Layer(source, values, " ".join(section.get("why", "").split()))
    for axis, chosen in zip(AXES, names, strict=True):
        for name in chosen:
            if name in section.get(axis, {}):
                inner = f"{source}.{axis}.{name}".replace(", .", ", ")
                yield from _layers(section[axis][name], names, inner)


def task_name(env_id: str) -> str:
    """Return an id without its namespace and version, such as ``"CloseLoopBlockPicking"``."""
    return env_id.rpartition("/")[2].partition("-v")[0]


@functools.cache
def families() -> tuple[Family, ...]:
    """Load all configuration files, in the order of their names."""
    folder = Path(__file__).resolve().parents[1] / "hyperparams"
    return tuple(parse_family(path.stem, path.read_text("utf-8")) for path in sorted(folder.glob("*.yml")))


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
