"""The cells of a benchmark: tasks x baselines x seeds, from a name of the paper's or a YAML file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from zoo_configs.arguments import MAX_SEED
from zoo_configs.cells.benchmarks import choose_benchmark
from zoo_configs.cells.cell import Cell, resolve
from zoo_configs.cells.rules import Family, family_of, task_name
from zoo_configs.environments import known_env_id, our_env_ids, register_environments
from zoo_configs.errors import CommandError, refused, unknown_name
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import SEED_PREFIX

SEEDS = 4  # paper, the captions of its learning curves: averaged over four runs
PATTERN = "*?["  # what makes a shell pattern of a name
SUFFIXES = (".yml", ".yaml")
# Learners and networks that are not in the paper: in its benchmarks only where they are named.
OTHERS = {"tqc", "tqcfd", "state"}


@dataclass(frozen=True)
class Plan:
    """
    What a YAML file of a benchmark says; these are its keys.

    :param tasks: Ids, names without namespace and version, or shell patterns of either
    :param baselines: Rows, or shell patterns of them
    :param preset: Size of the runs
    :param seeds: How many (0, 1, ...), or which
    :param benchmark: The benchmark whose parameters the tasks have; None takes the first that fits
    :param options: How cells are trained: fields of ``TrainingOptions``
    :param hyperparams: Hyperparameters that win over all rules
    """

    tasks: Sequence[str] = ()
    baselines: Sequence[str] = ()
    preset: str = "cpu"
    seeds: int | Sequence[int] = SEEDS
    benchmark: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    hyperparams: Mapping[str, Any] = field(default_factory=dict)


class Member(NamedTuple):
    """
    One run of a benchmark.

    :param cell: What is trained
    :param seed: Of model and environments
    :param options: How it is trained
    """

    cell: Cell
    seed: int
    options: TrainingOptions

    @property
    def name(self) -> str:
        """Its folder within the benchmark's: task, baseline, seed."""
        return f"{task_name(self.cell.env_id)}/{self.cell.label}/{SEED_PREFIX}{self.seed}"


@dataclass(frozen=True)
class Sweep:
    """
    All runs of a benchmark. Those that stand beside each other share no demonstrations, which so are
    collected once.

    :param name: Name of the benchmark, or of its file
    :param members: The runs, of distinct names, in the order in which they are begun
    :param gym_packages: Packages that register the environments, besides our own
    :param device: PyTorch device
    """

    name: str
    members: tuple[Member, ...]
    gym_packages: tuple[str, ...] = ()
    device: str = "auto"

    @property
    def cells(self) -> list[Cell]:
        """What is trained, without the seeds."""
        return [member.cell for member in self.members if member.seed == self.members[0].seed]


def read_plan(name: str) -> Plan:
    """
    Look up a benchmark.

    :param name: One of the paper's five, or a YAML file
    :return: What it says
    :raises CommandError: if there is none of that name, or the file cannot be followed
    """
    from bulletarm_gym.benchmarks import BENCHMARKS

    if Path(name).suffix in SUFFIXES:
        return parse_plan(name, _read(Path(name)))
    if name not in BENCHMARKS:
        raise unknown_name(
            "benchmark", name, BENCHMARKS, see=f"choose from {', '.join(BENCHMARKS)}, or a YAML file"
        )
    tasks = [environment.env_id for environment in BENCHMARKS[name].environments]
    family = family_of(tasks[0])
    rows = family.baselines.items()
    baselines = [
        row
        for row, baseline in rows
        if baseline.network in family.benchmarks[name] and OTHERS.isdisjoint(baseline[:2])
    ]
    return Plan(tasks, baselines, benchmark=name)


def _read(path: Path) -> Any:
    if not path.is_file():
        raise CommandError(f"there is no file {path}")
    with refused(f"{path} is not valid YAML"):
        return yaml.safe_load(path.read_text(encoding="utf-8"))


def parse_plan(where: str, content: Any) -> Plan:
    """
    Read what a YAML file says.

    :param where: What its errors call it
    :param content: The file's mapping
    :return: The plan
    :raises CommandError: for a key that does not exist, naming the nearest, or a value that it does not take
    """
    if not isinstance(content, dict):
        raise CommandError(f"{where} takes a mapping of keys, got {content!r}")
    keys = [item.name for item in fields(Plan)]
    for key in content:
        if key not in keys:
            raise unknown_name(f"key of {where}", str(key), keys)
    for key in ("tasks", "baselines"):
        _check_names(f"{key} of {where}", content.get(key))
    for key in ("options", "hyperparams"):
        if not isinstance(content.get(key, {}), dict):
            raise CommandError(f"{key} of {where} takes a mapping, got {content[key]!r}")
    return replace(Plan(), **content)


def _check_names(what: str, names: Any) -> None:
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise CommandError(f"{what} takes a list of names, got {names!r}")


def build_sweep(
    name: str, plan: Plan, gym_packages: Sequence[str] = (), device: str = "auto", num_threads: int = 1
) -> Sweep:
    """
    Resolve all cells of a plan.

    :param name: Name of the benchmark, or of its file
    :param plan: What it says
    :param gym_packages: Packages that register environments, besides our own
    :param device: PyTorch device
    :param num_threads: Threads of PyTorch of one run, unless the plan's options say
    :return: The runs
    :raises CommandError: for a task, baseline, preset, option or seed that does not exist; names the nearest
    """
    register_environments(gym_packages)
    tasks = [env_id for wanted in plan.tasks for env_id in _tasks(wanted, plan.benchmark)]
    rows = [(row, task) for task in dict.fromkeys(tasks) for row in _baselines(plan, task)]
    cells = [resolve(row, plan.preset, task, plan.hyperparams, plan.benchmark) for row, task in rows]
    given = {"num_threads": num_threads, **plan.options}
    members = [
        Member(cell, seed, TrainingOptions.of(cell, given))
        for label in dict.fromkeys(cell.label for cell in cells)
        for seed in _seeds(plan.seeds)
        for cell in cells
        if cell.label == label
    ]
    _check_distinct(members)
    return Sweep(name, tuple(members), tuple(gym_packages), device)


def _tasks(wanted: str, benchmark: str | None) -> list[str]:
    """The ids that a name means, or a pattern, of those in a benchmark."""
    from bulletarm_gym.benchmarks import BENCHMARKS

    named = {task_name(env_id): env_id for env_id in our_env_ids()}
    if wanted in named:
        return [named[wanted]]
    if not any(letter in wanted for letter in PATTERN):
        return [known_env_id(wanted)]
    found = [
        env_id for name, env_id in named.items() if fnmatchcase(name, wanted) or fnmatchcase(env_id, wanted)
    ]
    if benchmark is not None and benchmark in BENCHMARKS:
        tasks = {row.env_id for row in BENCHMARKS[benchmark].environments}
        found = [env_id for env_id in found if env_id in tasks]
    if not found:
        raise CommandError(f"no task is called {wanted!r}, see bulletarm-zoo list")
    return found


def _baselines(plan: Plan, env_id: str) -> list[str]:
    """The rows that a plan has for a task; what a pattern means besides, but does not fit it, is left out."""
    family = family_of(env_id)
    found: dict[str, None] = {}
    for wanted in plan.baselines:
        if not any(letter in wanted for letter in PATTERN):
            found[wanted] = None
        else:
            found |= dict.fromkeys(row for row in _fitting(family, env_id, plan) if fnmatchcase(row, wanted))
    if not found:
        raise CommandError(f"no baseline of {env_id} is called {' or '.join(plan.baselines)}")
    return list(found)


def _fitting(family: Family, env_id: str, plan: Plan) -> list[str]:
    fitting = []
    for name, row in family.baselines.items():
        try:
            choose_benchmark(family.benchmarks, env_id, row.network, plan.benchmark)
        except CommandError:
            continue
        fitting.append(name)
    return fitting


def _seeds(wanted: Any) -> list[int]:
    """How many, or which."""
    seeds = list(range(wanted)) if isinstance(wanted, int) and not isinstance(wanted, bool) else wanted
    if not isinstance(seeds, list | tuple) or not seeds or not all(_is_seed(seed) for seed in seeds):
        takes = "a number of seeds, at least 1, or a list of whole numbers of at least 0"
        raise CommandError(f"seeds takes {takes}, got {wanted!r}")
    return list(dict.fromkeys(seeds))


def _is_seed(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_SEED


def _check_distinct(members: Iterable[Member]) -> None:
    """No two runs may share a folder."""
    found: dict[str, str] = {}
    for member in members:
        other = found.setdefault(member.name, member.cell.env_id)
        if other != member.cell.env_id:
            raise CommandError(f"{other} and {member.cell.env_id} would share the folder {member.name}")
