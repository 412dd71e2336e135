"""What came of many runs: tables by cell and by baseline."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from zoo_configs.benchmarking.evaluated import EvaluatedRun
from zoo_configs.drawing.curves import SUCCESS
from zoo_configs.training.state import State

CONFIDENCE = 0.95
RESAMPLES = 9999  # scipy's own default
BOOTSTRAP_SEED = 0
TRIMMED = 0.25  # at either end: what is left is the interquartile mean (Agarwal et al. 2021)
CELL = ["task", "baseline"]


def run_table(runs: Iterable[EvaluatedRun]) -> pd.DataFrame:
    """
    How runs ended.

    :param runs: The runs
    :return: A row a run: task, baseline, seed, measure, timesteps and success of its last evaluation (mean
        over its episodes), episodes, state, minutes of training (NaN where it does not say), command
    """
    return pd.DataFrame([_row(run) for run in runs])


def _row(run: EvaluatedRun) -> dict[str, Any]:
    curve, minutes = run.curve, run.origin.minutes
    return {
        "task": run.env_id,
        "baseline": run.baseline,
        "seed": run.seed,
        "measure": curve.measure,
        "timesteps": int(curve.timesteps[-1]),
        "success": float(curve.success[-1]),
        "episodes": curve.episodes,
        "state": run.state,
        "minutes": np.nan if minutes is None else minutes,
        "command": run.origin.command,
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
