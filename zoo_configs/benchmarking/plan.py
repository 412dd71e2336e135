"""Experiments of a benchmark: tasks x baselines x seeds, from the paper's tables or a YAML file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from fnmatch import filter as fnfilter
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from bulletarm_gym.benchmarks import BENCHMARKS
from zoo_configs.arguments import MAX_SEED
from zoo_configs.environments import known_env_id, our_env_ids, package_of, register_environments
from zoo_configs.errors import CommandError, check_names, unknown_name
from zoo_configs.experiments.config import merge, resolve
from zoo_configs.experiments.families import family_of, task_name
from zoo_configs.experiments.flags import default_preset
from zoo_configs.files import read_yaml
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import SEED_PREFIX, Run

SEEDS = 4  # paper: the captions of its learning curves
PATTERN = "*?["
"""Characters that make a name a shell pattern."""
SUFFIXES = (".yml", ".yaml")
NOT_IN_PAPER = {"tqc", "tqcfd", "state"}
"""Learners and networks that the paper's benchmarks do not contain."""


@dataclass(frozen=True)
class Plan:
    """
    Content of a YAML file of a benchmark, whose keys are these fields.

    :param tasks: Ids, names without namespace and version, or shell patterns, also after ``"package:"``
    :param baselines: Baselines or shell patterns
    :param preset: Preset; None selects ``paper`` for a GPU, else ``cpu``
    :param seeds: Number of seeds (0, 1, ...), or a list of seeds
    :param benchmark: Benchmark whose parameters the tasks have; None selects the first that has the task
    :param options: Fields of ``TrainingOptions``
    :param hyperparams: Hyperparameters that replace the values of the baselines
    :param variants: Further hyperparameters by the names of variants. Each baseline has a run with each
    """

    tasks: Sequence[str] = ()
    baselines: Sequence[str] = ()
    preset: str | None = None
    seeds: int | Sequence[int] = SEEDS
    benchmark: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    hyperparams: Mapping[str, Any] = field(default_factory=dict)
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def read_plan(name: str) -> Plan:
    """Return the plan of one of the paper's benchmarks, or of a YAML file."""
    if Path(name).suffix in SUFFIXES:
        if not Path(name).is_file():
            raise CommandError(f"{name} does not exist")
        return parse_plan(name, read_yaml(Path(name)))
    if name not in BENCHMARKS:
        see = f"choose from {', '.join(BENCHMARKS)}, or pass a YAML file"
        raise unknown_name("benchmark", name, BENCHMARKS, see=see)
    tasks = [environment.env_id for environment in BENCHMARKS[name].environments]
    family = family_of(tasks[0])
    baselines = [
        label
        for label, baseline in family.baselines.items()
        if baseline.network in family.benchmarks[name] and NOT_IN_PAPER.isdisjoint(baseline[:2])
    ]
    return Plan(tasks, baselines, benchmark=name)


def parse_plan(where: str, content: Any) -> Plan:
    """Return the plan that a YAML file contains; ``where`` is its name in messages."""
    if not isinstance(content, dict):
        raise CommandError(f"{where} must contain a mapping, got {content!r}")
    check_names(f"key of {where}", map(str, content), [item.name for item in fields(Plan)])
    for key in ("tasks", "baselines"):
        if not isinstance(names := content.get(key), list) or not names:
            raise CommandError(f"{key} of {where} must be a list of names, got {names!r}")
    for key in ("options", "hyperparams", "variants"):
        if not isinstance(content.get(key, {}), dict):
            raise CommandError(f"{key} of {where} must be a mapping, got {content[key]!r}")
    for key in ("preset", "benchmark"):
        if not isinstance(content.get(key), str | None):
            raise CommandError(f"{key} of {where} must be a name, got {content[key]!r}")
    for name, values in content.get("variants", {}).items():
        if not isinstance(name, str) or not isinstance(values, dict) or "/" in name:
            raise CommandError(f"variants of {where} must be mappings by name, got {name!r}: {values!r}")
    names = {key: list(map(str, content[key])) for key in ("tasks", "baselines")}
    return Plan(**{**content, **names})


def build_jobs(
    plan: Plan, folder: Path, gym_packages: Sequence[str] = (), device: str = "auto", num_threads: int = 1
) -> list[Run]:
    """
    Return the runs of a plan in the order in which they start.

    Runs that follow each other have different tasks or seeds, so that each set of demonstrations is collected
    only once.

    :param folder: Folder of the benchmark. Those of the runs in it are ``<task>/<baseline>/seed_<n>`` or
        ``<task>/<baseline>-<variant>/seed_<n>``
    :param num_threads: Number of PyTorch threads of a run, unless the options of the plan define it
    :raises CommandError: for an unknown task, baseline, preset, option or seed
    """
    named = [package for task in plan.tasks for package in package_of(task)]
    packages = tuple(dict.fromkeys([*gym_packages, *named]))
    register_environments(packages)
    tasks = dict.fromkeys(env_id for wanted in plan.tasks for env_id in _tasks(wanted, plan.benchmark))
    preset = plan.preset or default_preset(device)
    experiments = [
        (
            folder / task_name(task) / (f"{label}-{variant}" if variant else label),
            resolve(label, preset, task, merge(plan.hyperparams, values), plan.benchmark),
        )
        for task in tasks
        for label in _baselines(plan, task)
        for variant, values in (plan.variants or {"": {}}).items()
    ]
    options = {"num_threads": num_threads, **plan.options}
    return [
        Run(place / f"{SEED_PREFIX}{seed}", one, seed, device, TrainingOptions.of(one, options), packages)
        for wanted in dict.fromkeys(place.name for place, _ in experiments)
        for seed in _seeds(plan.seeds)
        for place, one in experiments
        if place.name == wanted
    ]


def _tasks(wanted: str, benchmark: str | None) -> list[str]:
    """Return the ids of a name, or of a pattern within the benchmark."""
    ids, wanted = our_env_ids(), wanted.rpartition(":")[2]
    found = [name for name in ids if fnmatchcase(task_name(name), wanted) or fnmatchcase(name, wanted)]
    if not _is_pattern(wanted):
        return found or [known_env_id(wanted)]
    if benchmark is not None and benchmark in BENCHMARKS:
        tasks = {row.env_id for row in BENCHMARKS[benchmark].environments}
        found = [env_id for env_id in found if env_id in tasks]
    if not found:
        raise CommandError(f"no task fits the pattern {wanted!r}, see bulletarm-zoo list")
    return found


def _baselines(plan: Plan, env_id: str) -> list[str]:
    """Return the baselines of a plan for a task. Patterns select only baselines that the task has."""
    family = family_of(env_id)
    available = [name for name in family.baselines if family.has_experiment(name, env_id, plan.benchmark)]
    found: dict[str, None] = {}
    for wanted in plan.baselines:
        matching = fnfilter(available, wanted) if _is_pattern(wanted) else [wanted]
        found |= dict.fromkeys(matching)
    if not found:
        raise CommandError(f"no baseline of {env_id} fits {' or '.join(plan.baselines)}")
    return list(found)


def _is_pattern(name: str) -> bool:
    return any(letter in name for letter in PATTERN)


def _seeds(wanted: Any) -> list[int]:
    seeds = list(range(wanted)) if type(wanted) is int else wanted
    is_list = isinstance(seeds, list | tuple) and len(seeds) > 0
    if not is_list or not all(type(seed) is int and 0 <= seed <= MAX_SEED for seed in seeds):
        raise CommandError(f"seeds must be a positive number of seeds, or a list of seeds, got {wanted!r}")
    return list(dict.fromkeys(seeds))
