"""What came of many runs: tables by cell and by baseline, from their folders."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from zoo_configs.cells.cell import Cell, resolve
from zoo_configs.drawing.curves import SUCCESS, load_curve
from zoo_configs.errors import CommandError
from zoo_configs.measuring.provenance import command_line, env_kwargs_words, key_values
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run
from zoo_configs.training.state import State

CONFIDENCE = 0.95
RESAMPLES = 9999  # scipy's own default
BOOTSTRAP_SEED = 0
TRIMMED = 0.25  # at either end: what is left is the interquartile mean (Agarwal et al. 2021)
SECONDS_A_MINUTE = 60.0
CELL = ["task", "baseline"]


def run_table(runs: Sequence[Run]) -> pd.DataFrame:
    """
    How runs ended.

    :param runs: The runs, those that have been evaluated
    :return: A row a run: task, baseline, seed, measure, timesteps and success of its last evaluation (mean
        over its episodes), episodes, state, minutes of training (NaN where the folder does not say), command
    :raises CommandError: if an evaluation cannot be read
    """
    return pd.DataFrame([_row(run) for run in runs])


def _row(run: Run) -> dict[str, Any]:
    curve, how = load_curve(run.evaluations_file), run.standing
    return {
        "task": run.cell.env_id,
        "baseline": run.cell.label,
        "seed": run.seed,
        "measure": curve.measure,
        "timesteps": int(curve.timesteps[-1]),
        "success": float(curve.success[-1]),
        "episodes": curve.episodes,
        "state": "" if how is None else how.state.value,
        "minutes": np.nan if how is None else how.seconds / SECONDS_A_MINUTE,
        "command": repeating_command(run),
    }


def cell_table(runs: pd.DataFrame) -> pd.DataFrame:
    """
    How cells ended: means over seeds.

    :param runs: From :func:`run_table`
    :return: A row a cell: task, baseline, success, error (standard error over seeds), low and high (Wilson's
        95 % interval over the episodes of the last evaluations of all seeds; it does not see how seeds
        differ, the standard error does; NaN for returns), seeds, done (how many of them), episodes,
        timesteps, minutes, command
    """
    return pd.DataFrame([_cell(group) for _, group in runs.groupby(CELL, sort=True)])


def _cell(group: pd.DataFrame) -> dict[str, Any]:
    first, episodes = group.iloc[0], int(group["episodes"].sum())
    low, high = np.nan, np.nan
    if (group["measure"] == SUCCESS).all():
        successes = round(float((group["success"] * group["episodes"]).sum()))
        low, high = wilson_interval(successes, episodes)
    return {
        **{name: first[name] for name in CELL},
        "success": group["success"].mean(),
        "error": group["success"].sem(),
        "low": low,
        "high": high,
        "seeds": " ".join(str(seed) for seed in sorted(group["seed"])),
        "done": int((group["state"] == State.DONE.value).sum()),
        "episodes": episodes,
        "timesteps": int(group["timesteps"].max()),
        "minutes": group["minutes"].mean(),
        "command": first["command"],
    }


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """
    Wilson's 95 % interval of a success rate.

    :param successes: How many episodes succeeded
    :param episodes: Of how many
    :return: Its ends
    """
    interval = stats.binomtest(successes, episodes).proportion_ci(CONFIDENCE, "wilson")
    return float(interval.low), float(interval.high)


def baseline_table(runs: pd.DataFrame) -> pd.DataFrame:
    """
    How baselines ended over all tasks.

    :param runs: From :func:`run_table`
    :return: A row a baseline: its interquartile mean over runs of all tasks (iqm), the bootstrap's 95 %
        interval (low, high; NaN for a single run), mean, tasks, runs
    """
    rows = []
    for baseline, group in runs.groupby("baseline", sort=True):
        samples = [task["success"].to_numpy(dtype=float) for _, task in group.groupby("task")]
        low, high = bootstrap_interval(samples)
        scores = group["success"]
        iqm = float(stats.trim_mean(scores, TRIMMED))
        counts = {"tasks": len(samples), "runs": len(scores)}
        rows.append(
            {"baseline": baseline, "iqm": iqm, "low": low, "high": high, "mean": scores.mean(), **counts}
        )
    return pd.DataFrame(rows)


def bootstrap_interval(samples: Sequence[npt.NDArray[np.float64]]) -> tuple[float, float]:
    """
    Interval of an interquartile mean by the percentile bootstrap. Seeds are drawn anew within each task;
    where a task has one seed only, runs are drawn from all tasks together.

    :param samples: Of each task the successes of its seeds
    :return: Its ends, NaN for a single run
    """
    strata = list(samples) if min(map(len, samples)) > 1 else [np.concatenate(samples)]
    if min(map(len, strata)) < 2:
        return np.nan, np.nan
    found = stats.bootstrap(
        strata,
        lambda *drawn, axis: stats.trim_mean(np.concatenate(drawn, axis=axis), TRIMMED, axis=axis),
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(BOOTSTRAP_SEED),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def repeating_command(run: Run) -> str:
    """
    The command line that trains a run again.

    :param run: The run
    :return: What to type
    """
    cell, options = run.cell, run.options
    words = ["bulletarm-zoo", "train", "--env", cell.env_id, "--seed", str(run.seed)]
    base = _base(cell)
    if base is None:
        words += ["--conf-file", str(run.resolved_file), "--algo", cell.algo]
    else:
        words += ["--baseline", str(cell.baseline), "--preset", str(cell.preset)]
        words += ["--benchmark", cell.benchmark] if cell.benchmark else []
    words += [] if run.device == "auto" else ["--device", run.device]
    words += ["--gym-packages", *run.gym_packages] if run.gym_packages else []
    words += _flags(TrainingOptions.of(base) if base else TrainingOptions(), options)
    changed = _difference(base.hyperparams, cell.hyperparams) if base else {}
    words += env_kwargs_words(changed.pop("env_kwargs", {}))
    words += ["-params", *key_values(changed)] if changed else []
    return command_line(words)


def _base(cell: Cell) -> Cell | None:
    """The cell without overrides; None if there is none, or a command line cannot say them."""
    if cell.baseline is None or cell.preset is None:
        return None
    try:
        base = resolve(cell.baseline, cell.preset, cell.env_id, benchmark=cell.benchmark)
        changed = _difference(base.hyperparams, cell.hyperparams)
        again = resolve(cell.baseline, cell.preset, cell.env_id, changed, cell.benchmark)
    except CommandError:  # of another version, which had other names
        return None
    return base if again.hyperparams == cell.hyperparams else None


def _difference(base: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """What must be merged into a mapping to get another."""
    changed: dict[str, Any] = {}
    for key, value in wanted.items():
        below = base.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            if inner := _difference(below, value):
                changed[key] = inner
        elif key not in base or below != value:
            changed[key] = value
    return changed


def _flags(base: TrainingOptions, wanted: TrainingOptions) -> Iterator[str]:
    """Options that differ from a cell's own."""
    plain = base.plain()
    for name, value in wanted.plain().items():
        if value == plain[name] or value is None:
            continue
        yield f"--{name.replace('_', '-')}"
        if isinstance(value, Mapping):
            yield from (f"{key}:{item!r}" for key, item in value.items())
        elif isinstance(value, list):
            yield from value
        elif value is not True or name == "truncate_last_trajectory":
            yield str(value)
