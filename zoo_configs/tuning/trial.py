"""One trial of a study: a cell trained in a folder of its own, compared with others while it is trained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import optuna
from stable_baselines3.common.callbacks import BaseCallback

from zoo_configs.drawing.curves import LearningCurve, load_curve
from zoo_configs.training.runs import EVALUATIONS_FILE, Run

PRUNED = "pruned"  # attribute of a trial that was stopped early


class ReportToTrial(BaseCallback):
    """
    Tells a trial every evaluation of its run, and ends the training if the trial is to be pruned.

    :param trial: The trial
    :param folder: Run folder
    """

    def __init__(self, trial: optuna.Trial, folder: Path) -> None:
        super().__init__()
        self.trial = trial
        self.path = folder / EVALUATIONS_FILE
        self._seen = 0  # time of the file's last change
        self._told = 0  # evaluations

    def _on_step(self) -> bool:
        if not self.path.is_file() or (changed := self.path.stat().st_mtime_ns) == self._seen:
            return True
        self._seen = changed
        values = load_curve(self.path).success
        for step in range(self._told, len(values)):
            self.trial.report(float(values[step]), step)
        self._told = len(values)
        if self.trial.should_prune():
            self.trial.set_user_attr(PRUNED, True)
            return False
        return True


def score(run: Run) -> float:
    """
    What a study looks for: success that is high and stays.

    :param run: A run that has been evaluated
    :return: Mean success of the second half of its evaluations, mean return where there is no success
    """
    curve: LearningCurve = load_curve(run.evaluations_file)
    return float(np.mean(curve.success[len(curve.success) // 2 :]))
