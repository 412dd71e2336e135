"""Reports of a trial's evaluations to its study, and its score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import optuna
from stable_baselines3.common.callbacks import BaseCallback

from zoo_configs.drawing.curves import LearningCurve, load_curve
from zoo_configs.training.runs import EVALUATIONS_FILE, Run

PRUNED = "pruned"
"""Attribute of a pruned trial."""


class ReportToTrial(BaseCallback):
    """
    Callback that reports each evaluation of a run to its trial, and ends the training of a pruned trial.

    :param trial: The trial
    :param folder: Run folder
    """

    def __init__(self, trial: optuna.Trial, folder: Path) -> None:
        super().__init__()
        self.trial = trial
        self.path = folder / EVALUATIONS_FILE
        self._changed = 0  # time of the file's last change
        self._reported = 0  # number of evaluations

    def _on_step(self) -> bool:
        if not self.path.is_file() or (changed := self.path.stat().st_mtime_ns) == self._changed:
            return True
        self._changed = changed
        values = load_curve(self.path).success
        for step in range(self._reported, len(values)):
            self.trial.report(float(values[step]), step)
        self._reported = len(values)
        if self.trial.should_prune():
            self.trial.set_user_attr(PRUNED, True)
            return False
        return True


def score(run: Run) -> float:
    """
    Return the score of a run, which is high for success that lasts.

    :param run: An evaluated run
    :return: Mean success of the second half of its evaluations, or mean return without success
    """
    curve: LearningCurve = load_curve(run.evaluations_file)
    return float(np.mean(curve.success[len(curve.success) // 2 :]))
