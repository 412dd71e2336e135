"""Hyperparameters as axes and rules: what baselines are made of, and what holds when."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib import resources
from typing import Any, NamedTuple

import yaml

from zoo_configs.algorithms import ALGORITHMS
from zoo_configs.errors import CommandError, refused, unknown_name

FAMILY_KEYS = ("envs", "benchmarks", "baselines", "product", "algorithms", "rules")
AXES = ("preset", "task", "benchmark", "learner", "network", "addition")
RULE_KEYS = ("when", "why", "algo", "set", "flags")
# Flags of rl_zoo3.train for which a rule may choose the default.
RULE_FLAGS = ("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "vec_env", "log_interval")
NO_BENCHMARK = "none"


class Baseline(NamedTuple):
    """
    A row of a benchmark.

    :param learner: What is learned by
    :param network: On which network
    :param additions: With what besides, for example an augmentation
    """

    learner: str
    network: str
    additions: tuple[str, ...] = ()


class Case(NamedTuple):
    """
    What rules are asked about.

    :param preset: Size of the run
    :param env_id: Id of the environment
    :param benchmark: The benchmark whose parameters it has, None for a task of none
    :param baseline: The row
    """

    preset: str
    env_id: str
    benchmark: str | None
    baseline: Baseline

    def names(self, axis: str) -> tuple[str, ...]:
        """
        What a case is called along an axis.

        :param axis: One of ``AXES``
        :return: Its names there, several only along "addition"
        """
        learner, network, additions = self.baseline
        names: dict[str, tuple[str, ...]] = {
            "preset": (self.preset,),
            "task": (task_name(self.env_id),),
            "benchmark": (self.benchmark or NO_BENCHMARK,),
            "learner": (learner,),
            "network": (network,),
            "addition": additions,
        }
        return names[axis]


@dataclass(frozen=True)
class Rule:
    """
    What holds in some cases.

    :param where: The file and the rule's place in it
    :param when: From axis to the names, or shell patterns, of which one must fit; an axis that is not named
        may be anything
    :param why: The reason, or the source of the numbers
    :param algo: The algorithm, as rl_zoo3's table names it; None leaves it to other rules
    :param hyperparams: Hyperparameters; mappings are merged with those of earlier rules
    :param flags: Defaults for flags of ``train``
    """

    where: str
    when: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    why: str = ""
    algo: str | None = None
    hyperparams: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, Any] = field(default_factory=dict)

    def holds(self, case: Case) -> bool:
        """Whether it says something about a case."""
        return all(
            any(fnmatchcase(name, pattern) for name in case.names(axis) for pattern in patterns)
            for axis, patterns in self.when.items()
        )

    def __str__(self) -> str:
        given = [f"{axis} is {' or '.join(patterns)}" for axis, patterns in self.when.items()]
        return f"{self.where}: {', '.join(given)}" if given else self.where


@dataclass(frozen=True)
class Family:
    """
    One file of rules: the baselines and presets of a family of environments.

    :param name: Name of the file without its suffix
    :param envs: Shell pattern of the ids it serves
    :param benchmarks: From benchmark to the networks that serve it; a task is trained as in the first that
        has it and the network, unless another is named
    :param baselines: From name to learner, network and additions
    :param algorithms: From algorithm to the baselines that it alone stands for; the first that serves the
        task is taken
    :param rules: In the order in which they are applied; later ones win
    """

    name: str
    envs: str
    benchmarks: Mapping[str, tuple[str, ...]]
    baselines: Mapping[str, Baseline]
    algorithms: Mapping[str, tuple[str, ...]]
    rules: tuple[Rule, ...]

    @property
    def presets(self) -> tuple[str, ...]:
        """The presets that rules speak of."""
        named = itertools.chain.from_iterable(rule.when.get("preset", ()) for rule in self.rules)
        return tuple(dict.fromkeys(named))

    def serves(self, env_id: str) -> bool:
        """Whether the family has hyperparameters for an id."""
        return fnmatchcase(env_id, self.envs)


def task_name(env_id: str) -> str:
    """
    An id without its namespace and version.

    :param env_id: ``"BulletArm/CloseLoopBlockPicking-v0"``
    :return: ``"CloseLoopBlockPicking"``
    """
    return env_id.rpartition("/")[2].partition("-v")[0]


@functools.cache
def families() -> tuple[Family, ...]:
    """
    Load all files of rules.

    :return: The families in order of their file names
    :raises CommandError: if a file has a key or a name that means nothing
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


def parse_family(name: str, text: str) -> Family:
    """
    Read a file of rules.

    :param name: Name of the file without its suffix
    :param text: What it says, in YAML
    :return: The family
    :raises CommandError: if a key or a name means nothing; names the nearest one that does
    """
    where = f"{name}.yml"
    with refused(f"{where} cannot be read"):
        data = yaml.safe_load(text)
    _check_names(f"key of {where}", data, FAMILY_KEYS)
    baselines = {**_products(data.get("product", {})), **_rows(where, data.get("baselines", {}))}
    rules = tuple(
        parse_rule(f"{where}, rule {number}", rule) for number, rule in enumerate(data["rules"], start=1)
    )
    benchmarks = {key: tuple(networks) for key, networks in data.get("benchmarks", {}).items()}
    algorithms = _algorithms(where, data.get("algorithms", {}), baselines)
    family = Family(name, data["envs"], benchmarks, baselines, algorithms, rules)
    _check_axes(family)
    return family


def parse_rule(where: str, data: Mapping[str, Any]) -> Rule:
    """
    Read a rule.

    :param where: What its errors call it
    :param data: Its keys: when, why, algo, set, flags
    :return: The rule
    :raises CommandError: for a key that means nothing
    """
    _check_names(f"key of {where}", data, RULE_KEYS)
    _check_names(f"axis of {where}", data.get("when", {}), AXES)
    _check_names(f"flag of {where}", data.get("flags", {}), RULE_FLAGS)
    when = _lists(data.get("when", {}))
    why = " ".join(data.get("why", "").split())
    return Rule(where, when, why, data.get("algo"), data.get("set", {}), data.get("flags", {}))


def _products(product: Mapping[str, Any]) -> dict[str, Baseline]:
    """A baseline of every learner on every network."""
    pairs = itertools.product(product.get("learners", ()), product.get("networks", ()))
    return {f"{learner}_{network}": Baseline(learner, network) for learner, network in pairs}


def _rows(where: str, rows: Mapping[str, Any]) -> dict[str, Baseline]:
    baselines = {}
    for name, row in rows.items():
        if not isinstance(row, list) or len(row) < 2:
            raise CommandError(f"{name!r} of {where} takes [learner, network, additions], got {row!r}")
        learner, network, *additions = row
        baselines[name] = Baseline(learner, network, tuple(additions))
    return baselines


def _algorithms(
    where: str, given: Mapping[str, Any], baselines: Mapping[str, Baseline]
) -> dict[str, tuple[str, ...]]:
    _check_names(f"algorithm of {where}", given, ALGORITHMS)
    algorithms = _lists(given)
    for algo, names in algorithms.items():
        _check_names(f"baseline of {where}, algorithm {algo}", names, baselines)
    return algorithms


def _lists(given: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """A name stands for a list of one."""
    return {key: (names,) if isinstance(names, str) else tuple(names) for key, names in given.items()}


def _check_axes(family: Family) -> None:
    """A name in a rule that no baseline has would never hold: a misspelling."""
    rows = family.baselines.values()
    names = {
        "learner": {row.learner for row in rows},
        "network": {row.network for row in rows},
        "addition": {addition for row in rows for addition in row.additions},
        "benchmark": {*family.benchmarks, NO_BENCHMARK},
    }
    for rule in family.rules:
        for axis, valid in names.items():
            for pattern in rule.when.get(axis, ()):
                if not any(fnmatchcase(name, pattern) for name in valid):
                    raise unknown_name(f"{axis} of {rule.where}", pattern, valid)


def _check_names(kind: str, given: Iterable[str], valid: Collection[str]) -> None:
    for name in given:
        if name not in valid:
            raise unknown_name(kind, name, valid)
