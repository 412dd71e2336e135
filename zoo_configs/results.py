"""Results of many runs: experiments, success by seed, and tables."""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from zoo_configs.cells.rules import task_name
from zoo_configs.drawing.curves import LearningCurve, load_curve
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.errors import CommandError
from zoo_configs.files import whole_file
from zoo_configs.training.origin import Origin, origin_of
from zoo_configs.training.runs import Run, find_runs
from zoo_configs.training.state import State

NOT_OF_THE_EXPERIMENT = {
    *("eval_episodes", "eval_freq", "log_interval", "n_eval_envs", "num_threads", "save_freq"),
    *("save_replay_buffer", "tensorboard_log", "track", "uuid", "vec_env", "verbose"),
    *("wandb_entity", "wandb_group", "wandb_project_name", "wandb_tags", "n_timesteps"),
}
"""Training options that do not change what a run learns. ``n_timesteps`` is that of the hyperparameters."""
AXES = ("preset", "benchmark")
"""Properties that label a curve before any hyperparameter does."""
TRIMMED = 4
"""The interquartile mean omits one in four values at each end."""
HEADS = ("task", "baseline", "success", "by seed", "done", "steps", "minutes")
BASELINE_HEADS = ("baseline", "interquartile mean", "by seed", "mean", "tasks", "runs")
RUN_HEADS = ("env", "baseline", "seed", "success", "steps", "done", "minutes", "machine", "command")
EXPLANATION = """Success: success rate in the last evaluation, mean over the seeds and by seed. Minutes: mean
duration of a run. Over all tasks: interquartile mean over the runs of all tasks, and by seed over the tasks.
The tables show each seed instead of a confidence interval, for which two to five seeds are too few."""


@dataclass(frozen=True)
class Result:
    """
    Evaluations of one run.

    :param run: The run
    :param curve: Its evaluations
    :param settings: Everything that defines the experiment, except environment and seed
    :param origin: Its origin
    """

    run: Run
    curve: LearningCurve
    settings: Mapping[str, Any]
    origin: Origin

    @property
    def success(self) -> float:
        """Mean of the last evaluation."""
        return float(self.curve.success[-1])

    @property
    def is_done(self) -> bool:
        """Whether the run is done."""
        status = self.run.standing
        return status is not None and status.state is State.DONE


@dataclass
class Experiment:
    """
    Runs that differ only in their seeds.

    :param env_id: Id of the environment
    :param label: Baseline, with the settings that distinguish it from other experiments on this environment
    :param results: Results, by seed
    """

    env_id: str
    label: str
    results: list[Result] = field(default_factory=list)

    @property
    def success(self) -> dict[int, float]:
        """Success in the last evaluation, by seed."""
        return {result.run.seed: result.success for result in self.results}


def read_experiments(
    log_folder: Path, env_ids: Sequence[str] | None = None, baselines: Sequence[str] | None = None
) -> list[Experiment]:
    """
    Read the evaluated runs in a folder and group them by experiment.

    :param log_folder: Folder of all runs, or of a benchmark
    :param env_ids: Ids of environments, None for all
    :param baselines: Baselines, None for all
    :raises CommandError: if there is no such run
    """
    runs = [
        run
        for run in find_runs(log_folder)
        if run.evaluations_file.is_file()
        and (env_ids is None or run.cell.env_id in env_ids)
        and (baselines is None or run.cell.baseline in baselines)
    ]
    if not runs:
        raise CommandError(f"no evaluated run of these environments and baselines in {log_folder}")
    return group(
        Result(run, load_curve(run.evaluations_file), settings_of(run), origin_of(run)) for run in runs
    )


def settings_of(run: Run) -> dict[str, Any]:
    """Return what defines the experiment of a run, except environment and seed, by dotted name."""
    cell, options = run.cell, run.options.plain()
    kept = {name: value for name, value in options.items() if name not in NOT_OF_THE_EXPERIMENT}
    hyperparams = dict(cell.hyperparams)
    if options["n_timesteps"] > 0:
        hyperparams["n_timesteps"] = options["n_timesteps"]
    settings = {"algo": cell.algo, "preset": cell.preset, "benchmark": cell.benchmark, **kept}
    return {**settings, **dict(_flat(hyperparams))}


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Yield the values of nested mappings by dotted name; parameters of the environment have no prefix."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, "" if name == "env_kwargs" else f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def group(results: Iterable[Result]) -> list[Experiment]:
    """
    Group results by experiment, sorted by environment and label.

    Of runs with the same experiment and seed, the longest one counts.
    """
    groups: defaultdict[tuple[str, str], list[list[Result]]] = defaultdict(list)
    for result in results:
        known = groups[result.run.cell.env_id, result.run.cell.label]
        found = next((group for group in known if group[0].settings == result.settings), None)
        if found is None:
            known.append([result])
        else:
            _add(found, result)
    experiments = [
        Experiment(env_id, label, sorted(group, key=lambda result: result.run.seed))
        for (env_id, baseline), known in groups.items()
        for label, group in zip(_labels(baseline, known), known, strict=True)
    ]
    return sorted(experiments, key=lambda experiment: (experiment.env_id, experiment.label))


def _add(group: list[Result], result: Result) -> None:
    """Add a result to a group, or let it replace a shorter one with the same seed."""
    same = [index for index, other in enumerate(group) if other.run.seed == result.run.seed]
    if not same:
        group.append(result)
        return
    index = same[0]
    left, kept = sorted((group[index], result), key=lambda one: one.curve.timesteps[-1])
    group[index] = kept
    print(f"left out: {left.run.folder} repeats {kept.run.folder}", file=sys.stderr)


def _labels(baseline: str, groups: Sequence[Sequence[Result]]) -> list[str]:
    """Return the baseline with the settings that differ between groups: preset and benchmark first."""
    settings = [group[0].settings for group in groups]
    axes = [axis for axis in AXES if _differ(axis, settings)]
    labels = []
    for own in settings:
        alike = [other for other in settings if all(other[axis] == own[axis] for axis in axes)]
        names = [*axes, *(name for name in _names(alike) if name not in axes and _differ(name, alike))]
        labels.append(", ".join([baseline, *(f"{name}={own.get(name)}" for name in names)]))
    return labels


def _names(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    return sorted({name for one in settings for name in one})


def _differ(name: str, settings: Sequence[Mapping[str, Any]]) -> bool:
    return any(one.get(name) != settings[0].get(name) for one in settings)


def interquartile_mean(values: Sequence[float]) -> float:
    """Return the mean without the lowest and the highest quarter of the values (Agarwal et al. 2021)."""
    omitted = len(values) // TRIMMED
    return float(np.mean(sorted(values)[omitted : len(values) - omitted]))


def experiment_row(experiment: Experiment) -> list[str]:
    """Return the row of an experiment with the columns ``HEADS``."""
    results, success = experiment.results, experiment.success
    minutes = [result.origin.minutes for result in results if result.origin.minutes is not None]
    return [
        task_name(experiment.env_id),
        experiment.label,
        f"{np.mean(list(success.values())):.2f}",
        _by_seed(success),
        f"{sum(result.is_done for result in results)} of {len(results)}",
        str(max(int(result.curve.timesteps[-1]) for result in results)),
        f"{np.mean(minutes):.1f}" if minutes else "",
    ]


def baseline_rows(experiments: Iterable[Experiment]) -> list[list[str]]:
    """Return the rows of the table of baselines over all tasks, with the columns ``BASELINE_HEADS``."""
    groups: defaultdict[str, list[Experiment]] = defaultdict(list)
    for experiment in experiments:
        groups[experiment.label].append(experiment)
    return [_baseline_row(label, group) for label, group in sorted(groups.items())]


def _baseline_row(label: str, experiments: Sequence[Experiment]) -> list[str]:
    by_seed: defaultdict[int, list[float]] = defaultdict(list)
    for experiment in experiments:
        for seed, success in experiment.success.items():
            by_seed[seed].append(success)
    values = [value for of_seed in by_seed.values() for value in of_seed]
    seeds = {seed: interquartile_mean(by_seed[seed]) for seed in sorted(by_seed)}
    means = f"{interquartile_mean(values):.2f}", _by_seed(seeds), f"{np.mean(values):.2f}"
    return [label, *means, str(len(experiments)), str(len(values))]


def _by_seed(values: Mapping[int, float]) -> str:
    return ", ".join(f"{seed}: {value:.2f}" for seed, value in values.items())


def write_tables(experiments: Sequence[Experiment], picture: Path) -> list[Path]:
    """
    Write the results next to a figure, with the same name.

    :return: A Markdown file with figure, tables, commands and machines, and a CSV file with one row a run
    """
    page, table = picture.with_suffix(".md"), picture.with_suffix(".csv")
    commands = [experiment.results[0].origin.command for experiment in experiments]
    parts = [
        f"![Success in the evaluations, mean over the seeds and its standard error]({picture.name})",
        markdown_table(HEADS, list(map(experiment_row, experiments))),
        markdown_table(BASELINE_HEADS, baseline_rows(experiments)),
        EXPLANATION,
        "Commands that repeat the first seed of each experiment:",
        "\n".join(f"    {command}" for command in commands),
        "Machines:",
        "\n".join(f"- {machine}" for machine in _machines(experiments)),
    ]
    with whole_file(page) as partial:
        partial.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    with whole_file(table) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(RUN_HEADS)
        writer.writerows(_run_row(one, result) for one in experiments for result in one.results)
    return [page, table]


def _run_row(experiment: Experiment, result: Result) -> list[Any]:
    origin, done = result.origin, "yes" if result.is_done else "no"
    last = result.success, int(result.curve.timesteps[-1]), done, origin.minutes
    return [experiment.env_id, experiment.label, result.run.seed, *last, origin.machine, origin.command]


def _machines(experiments: Iterable[Experiment]) -> list[str]:
    """Return machine, device, commit and versions of the runs, each combination once."""
    results = [result for experiment in experiments for result in experiment.results]
    return list(
        dict.fromkeys(
            f"{result.origin.machine}, device {result.run.device}, commit {result.origin.commit}; "
            + ", ".join(f"{name} {version}" for name, version in result.origin.versions.items())
            for result in results
        )
    )
