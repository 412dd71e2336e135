"""What a study has found: the best hyperparameters as YAML, and its pictures."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.exceptions import ExperimentalWarning
from optuna.trial import FrozenTrial, TrialState

from zoo_configs.files import whole_file
from zoo_configs.training.runs import load_run
from zoo_configs.tuning.study import Search, describe, retried, trial_folder

BEST_FILE = "best.yml"
DOTS_PER_INCH = 120
PICTURE_SIZE = (9.0, 5.0)  # inches
LEAST_TRIALS = 2  # that make a picture


def write_report(search: Search, study: optuna.Study, plots: bool = True) -> list[Path]:
    """
    Write what a study has found so far.

    :param search: What is searched
    :param study: The study
    :param plots: Whether to draw history, importances and parallel coordinates
    :return: The files; none as long as no trial is complete
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        return []
    files = [_write_best(search, study.best_trial)]
    return [*files, *_draw(search.folder, study)] if plots and len(complete) >= LEAST_TRIALS else files


def summary(study: optuna.Study) -> str:
    """
    Count a study's trials.

    :param study: The study
    :return: How many ended how; a trial that another has taken up is not counted
    """
    trials = study.get_trials(deepcopy=False)
    again = retried(trials)
    states = [trial.state.name.lower() for trial in trials if trial.number not in again]
    return ", ".join(f"{states.count(name)} {name}" for name in dict.fromkeys(states))


def _write_best(search: Search, trial: FrozenTrial) -> Path:
    """In the form of ``train --conf-file``."""
    run = load_run(trial_folder(search, trial))
    path = search.folder / BEST_FILE
    with whole_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(f"# {search.name}, {describe(trial)}\n")
        hyperparams = {**run.cell.hyperparams, "n_timesteps": run.options.n_timesteps}
        yaml.safe_dump({run.cell.env_id: hyperparams}, file, sort_keys=False)
    return path


def _draw(folder: Path, study: optuna.Study) -> list[Path]:
    import matplotlib as mpl

    mpl.use("Agg")
    from optuna.visualization import matplotlib as visualization

    pictures: dict[str, Callable[[optuna.Study], Any]] = {
        "history": visualization.plot_optimization_history,
        "importances": visualization.plot_param_importances,
        "parallel_coordinates": visualization.plot_parallel_coordinate,
    }
    return [_save(folder / f"{name}.png", draw, study) for name, draw in pictures.items()]


def _save(path: Path, draw: Callable[[optuna.Study], Any], study: optuna.Study) -> Path:
    from matplotlib import pyplot as plt

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        axes = draw(study)
    axes.figure.set_size_inches(PICTURE_SIZE)
    with whole_file(path) as partial:
        axes.figure.savefig(partial, dpi=DOTS_PER_INCH, bbox_inches="tight")
    plt.close(axes.figure)
    return path
