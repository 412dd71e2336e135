"""Runs by what their evaluations measured: from their folders, or from a file that outlives these."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zoo_configs.drawing.curves import SUCCESS, LearningCurve, load_curve
from zoo_configs.errors import refused
from zoo_configs.measuring.data_files import CURVES, DataFile, Record, number
from zoo_configs.training.origin import Origin, origin_of
from zoo_configs.training.runs import Run

DIGITS = 4
BETWEEN = ":"  # step and success of an evaluation


@dataclass(frozen=True)
class EvaluatedRun:
    """
    What the evaluations of a run measured.

    :param env_id: Id of the environment
    :param baseline: What was trained
    :param seed: Of model and environments
    :param curve: The evaluations, at least one
    :param state: How the run stands, as :class:`~zoo_configs.training.state.State` says it; empty if unknown
    :param origin: Where it comes from
    """

    env_id: str
    baseline: str
    seed: int
    curve: LearningCurve
    state: str
    origin: Origin

    @classmethod
    def of(cls, run: Run) -> EvaluatedRun:
        """
        Read a run's folder.

        :param run: The run; it has been evaluated
        :raises CommandError: if its files cannot be read
        """
        curve, how = load_curve(run.evaluations_file), run.standing
        state = "" if how is None else how.state.value
        return cls(run.cell.env_id, run.cell.label, run.seed, curve, state, origin_of(run))

    @classmethod
    def of_record(cls, row: Record) -> EvaluatedRun:
        """
        Read a row of a file; the standard error is that over the episodes, for returns not known.

        :param row: As :meth:`record` gives it
        :raises ValueError: if it is not one
        """
        pairs = [pair.split(BETWEEN) for pair in row["evaluations"].split()]
        steps = np.array([int(step) for step, _ in pairs])
        success, episodes = np.array([float(value) for _, value in pairs]), int(row["episodes"])
        if not len(pairs):
            raise ValueError("no evaluations")
        variance = success * (1 - success) if row["measure"] == SUCCESS else np.full(len(pairs), np.nan)
        ones = np.ones(len(pairs), dtype=np.int64)
        error = np.sqrt(variance / episodes)
        curve = LearningCurve(steps, success, error, row["measure"], ones, episodes)
        minutes = float(row["minutes"]) if row["minutes"] else None
        origin = Origin(minutes, row["command"], row["commit"], row["date"], row["machine"], {})
        return cls(row["env"], row["baseline"], int(row["seed"]), curve, row["state"], origin)

    def record(self) -> Record:
        """:return: A row of a file of curves"""
        curve, origin = self.curve, self.origin
        pairs = zip(curve.timesteps, curve.success, strict=True)
        return {
            "env": self.env_id,
            "baseline": self.baseline,
            "seed": str(self.seed),
            "measure": curve.measure,
            "episodes": str(curve.episodes),
            "evaluations": " ".join(f"{step}{BETWEEN}{number(value, DIGITS)}" for step, value in pairs),
            "state": self.state,
            "minutes": number(math.nan if origin.minutes is None else origin.minutes, 1),
            "machine": origin.machine,
            "date": origin.date,
            "commit": origin.commit,
            "command": origin.command,
        }


def keep_curves(runs: Iterable[EvaluatedRun], path: Path) -> list[EvaluatedRun]:
    """
    Put runs into a file of curves, in the place of those of the same environment, baseline and seed.

    :param runs: The runs
    :param path: The CSV, which need not exist
    :return: All runs of the file
    :raises CommandError: if it is no such file
    """
    data = DataFile(path, CURVES)
    for run in runs:
        data.add(run.record())
    with refused(f"--data: {path} is damaged"):
        return [EvaluatedRun.of_record(row) for row in data.read("--data")]
