"""Results of many runs: experiments, success by seed, and tables."""

import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import trim_mean

from zoo_configs.drawing.curves import LearningCurve, load_curve
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import leaves
from zoo_configs.experiments.families import task_name
from zoo_configs.files import whole_file
from zoo_configs.training.runs import SEED_PREFIX, Origin, Run, find_runs, origin_of
from zoo_configs.training.state import State

AXES = ("preset", "benchmark")
"""Settings that label an experiment before any hyperparameter does."""
HEADS = ("task", "baseline", "success", "by seed", "done", "steps", "minutes")
BASELINE_HEADS = ("baseline", "interquartile mean", "by seed", "mean", "tasks", "runs")
RUN_HEADS = ("env", "baseline", "seed", "success", "steps", "done", "minutes", "machine", "command")
EXPLANATION = """Success: success rate in the last evaluation, mean over the seeds and by seed. Minutes: mean
duration of a run. Over all tasks: interquartile mean over the runs of all tasks, and by seed over the tasks.
The tables show each seed instead of a confidence interval, for which two to five seeds are too few."""


@dataclass(frozen=True)
class Result:
    """Evaluations and origin of one run."""

    run: Run
    curve: LearningCurve
    origin: Origin
    is_done: bool

    @property
    def success(self) -> float:
        """Mean of the last evaluation."""
        return float(self.curve.success[-1])

    @property
    def steps(self) -> int:
        """Time step of the last evaluation."""
        return int(self.curve.timesteps[-1])


@dataclass(frozen=True)
class ExperimentResults:
    """
    Runs that differ only in their seeds.

    :param env_id: Id of the environment
    :param label: Baseline, with its variant or the settings in which other experiments of this task differ
    :param results: Results by seed
    """

    env_id: str
    label: str
    results: dict[int, Result]

    @property
    def success(self) -> dict[int, float]:
        """Success in the last evaluation, by seed."""
        return {seed: result.success for seed, result in self.results.items()}


def read_experiments(
    log_folder: Path,
    env_ids: Sequence[str] | None = None,
    baselines: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    device: str | None = None,
) -> list[ExperimentResults]:
    """
    Read the evaluated runs in a folder, and group them by experiment.

    Of runs with the same experiment and seed, the longest one counts.

    :param env_ids: Ids of environments, None for all
    :param baselines: Baselines, None for all
    :param seeds: Seeds, None for all
    :param device: Value of ``--device`` of the runs, None for all
    :return: The experiments, sorted by environment and label, numbers by value
    :raises CommandError: if no run fits
    """
    groups: defaultdict[str, list[Run]] = defaultdict(list)
    for run in find_runs(log_folder):
        is_wanted = env_ids is None or run.experiment.env_id in env_ids
        is_wanted &= baselines is None or run.experiment.label in baselines
        is_wanted &= (seeds is None or run.seed in seeds) and device in (None, run.device)
        if is_wanted and run.evaluations_file.is_file():
            groups[json.dumps(settings_of(run), default=str)].append(run)
    if not groups:
        must = "a folder with evaluated runs that match the other flags"
        raise CommandError(f"--log-folder must be {must}, got {log_folder}")
    settings = [settings_of(runs[0]) for runs in groups.values()]
    found = [
        ExperimentResults(own["env"], variant_label(runs[0]) or _label(own, settings), _by_seed(runs))
        for own, runs in zip(settings, groups.values(), strict=True)
    ]
    return sorted(found, key=_order)


def _order(experiment: ExperimentResults) -> tuple[str, list[str | int]]:
    """Return the sort key of an experiment; numbers in labels have their numeric order."""
    words = re.split(r"(\d+)", experiment.label)
    return experiment.env_id, [int(word) if word.isdecimal() else word for word in words]


def _by_seed(runs: Iterable[Run]) -> dict[int, Result]:
    """Return the results of an experiment, of the longest run with each seed."""
    curves = [(run, load_curve(run.evaluations_file)) for run in runs]
    results: dict[int, Result] = {}
    for run, curve in sorted(curves, key=lambda pair: (pair[0].seed, pair[1].timesteps[-1])):
        if run.seed in results:
            print(f"left out: {results[run.seed].run.folder} repeats {run.folder}", file=sys.stderr)
        results[run.seed] = Result(run, curve, origin_of(run), run.status.state is State.DONE)
    return results


def settings_of(run: Run) -> dict[str, Any]:
    """Return what defines the experiment of a run, except its seed, by dotted name."""
    experiment = run.experiment
    axes = {name: getattr(experiment, name) for name in ("algo", *AXES)}
    values = {name.removeprefix("env_kwargs."): value for name, value in leaves(experiment.hyperparams)}
    options = {"trained_agent": run.options.trained_agent, "n_timesteps": run.n_timesteps}
    return {**axes, **values, **options, "env": experiment.env_id, "baseline": experiment.label}


def variant_label(run: Run) -> str:
    """Return baseline and variant of a run of a benchmark with variants, "" for other runs."""
    baseline, variant = run.experiment.label, run.folder.parent.name
    is_variant = run.folder.name.startswith(SEED_PREFIX) and variant.startswith(f"{baseline}-")
    return f"{baseline}, {variant.removeprefix(f'{baseline}-')}" if is_variant else ""


def _label(own: Mapping[str, Any], others: Iterable[Mapping[str, Any]]) -> str:
    """Return the baseline with the settings that differ from its others, first the settings in ``AXES``."""
    alike = [one for one in others if (one["env"], one["baseline"]) == (own["env"], own["baseline"])]
    named: list[str] = []
    for names in (AXES, sorted({name for one in alike for name in one})):
        alike = [one for one in alike if all(one[name] == own[name] for name in named)]
        differing = [name for name in names if any(one.get(name) != own.get(name) for one in alike)]
        named += [name for name in differing if name not in named]
    return ", ".join([own["baseline"], *(f"{name}={own.get(name)}" for name in named)])


def interquartile_mean(values: Sequence[float]) -> float:
    """Return the mean without the lowest and the highest quarter of the values (Agarwal et al. 2021)."""
    return float(trim_mean(values, 0.25))


def experiment_row(experiment: ExperimentResults) -> list[str]:
    """Return the row of an experiment with the columns ``HEADS``."""
    results, success = experiment.results.values(), experiment.success
    done = [result.origin for result in results if result.is_done]
    minutes = [origin.minutes for origin in done if origin.minutes is not None]
    return [
        task_name(experiment.env_id),
        experiment.label,
        f"{np.mean(list(success.values())):.2f}",
        _listed(success),
        f"{len(done)} of {len(results)}",
        str(max(result.steps for result in results)),
        f"{np.mean(minutes):.1f}" if minutes else "",
    ]


def baseline_rows(experiments: Iterable[ExperimentResults]) -> list[list[str]]:
    """Return the rows of the table of baselines over all tasks, with the columns ``BASELINE_HEADS``."""
    groups: defaultdict[str, list[dict[int, float]]] = defaultdict(list)
    for experiment in experiments:
        groups[experiment.label].append(experiment.success)
    rows = []
    for label, tasks in sorted(groups.items()):
        values = [value for task in tasks for value in task.values()]
        seeds = sorted({seed for task in tasks for seed in task})
        by_seed = {seed: interquartile_mean([task[seed] for task in tasks if seed in task]) for seed in seeds}
        means = f"{interquartile_mean(values):.2f}", _listed(by_seed), f"{np.mean(values):.2f}"
        rows.append([label, *means, str(len(tasks)), str(len(values))])
    return rows


def _listed(values: Mapping[int, float]) -> str:
    return ", ".join(f"{seed}: {value:.2f}" for seed, value in values.items())


def write_tables(experiments: Sequence[ExperimentResults], figure: Path) -> list[Path]:
    """Write a Markdown page with figure, tables and commands, and a CSV of the runs, next to a figure."""
    page, table = figure.with_suffix(".md"), figure.with_suffix(".csv")
    results = [(one.env_id, one.label, result) for one in experiments for result in one.results.values()]
    parts = [
        f"![Success in the evaluations, mean over the seeds and its standard error]({figure.name})",
        markdown_table(HEADS, list(map(experiment_row, experiments))),
        markdown_table(BASELINE_HEADS, baseline_rows(experiments)),
        EXPLANATION,
        "Commands that repeat the first seed of each experiment:",
        "\n".join(f"    {next(iter(one.results.values())).origin.command}" for one in experiments),
        "Machines:",
        "\n".join(dict.fromkeys(_machine(result) for *_, result in results)),
    ]
    with whole_file(page) as partial:
        partial.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    with whole_file(table) as partial:
        rows = [_run_row(*one) for one in results]
        pd.DataFrame(rows, columns=RUN_HEADS).to_csv(partial, index=False)
    return [page, table]


def _run_row(env_id: str, label: str, result: Result) -> list[Any]:
    origin, done = result.origin, "yes" if result.is_done else "no"
    last = result.success, result.steps, done, origin.minutes
    return [env_id, label, result.run.seed, *last, origin.machine, origin.command]


def _machine(result: Result) -> str:
    origin = result.origin
    versions = ", ".join(f"{name} {version}" for name, version in origin.versions.items())
    return f"- {origin.machine}, device {result.run.device}, commit {origin.commit}; {versions}"
