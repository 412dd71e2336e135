"""Results of a study: the best hyperparameters as YAML, and plots."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.importance import PedAnovaImportanceEvaluator
from optuna.trial import FrozenTrial, TrialState

from zoo_configs.errors import CommandError
from zoo_configs.files import whole_file
from zoo_configs.training.runs import load_run
from zoo_configs.tuning.study import ERROR, Search, describe, retried, trial_folder
from zoo_configs.yaml_files import write_yaml

BEST_FILE = "best.yml"
DOTS_PER_INCH = 120
PLOT_SIZE = (9.0, 5.0)
"""Width and height in inches."""
LEAST_TRIALS = 2
"""Complete trials that the plots need."""


def write_report(search: Search, study: optuna.Study, plots: bool = True) -> list[Path]:
    """
    Write the results of a study so far.

    :param search: The study's subject and settings
    :param study: The study
    :param plots: Whether to plot history, importances and parallel coordinates
    :return: The files; none without a complete trial
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
    :return: Number of trials by state, without repeated ones
    """
    trials = study.get_trials(deepcopy=False)
    again = retried(trials)
    states = [trial.state.name.lower() for trial in trials if trial.number not in again]
    return ", ".join(f"{states.count(name)} {name}" for name in dict.fromkeys(states))


def _write_best(search: Search, trial: FrozenTrial) -> Path:
    """Write the hyperparameters of the best trial for ``train --conf-file``."""
    run = load_run(trial_folder(search, trial))
    path = search.folder / BEST_FILE
    hyperparams = {**run.experiment.hyperparams, "n_timesteps": run.n_timesteps}
    write_yaml(path, {run.experiment.env_id: hyperparams}, f"{search.name}, {describe(trial)}")
    return path


def check_complete(search: Search, study: optuna.Study) -> None:
    """
    Check that a study has a complete trial, or one that another process is training.

    :param search: The study's subject and settings
    :param study: The study
    :raises CommandError: if it has neither
    """
    trials = study.get_trials(deepcopy=False)
    if any(trial.state is TrialState.COMPLETE or not trial.state.is_finished() for trial in trials):
        return
    errors = [trial.user_attrs[ERROR] for trial in trials if ERROR in trial.user_attrs]
    why = f". First error: {errors[0]}" if errors else ""
    raise CommandError(f"study {search.name} has no complete trial of {len(trials)}{why}")


def _draw(folder: Path, study: optuna.Study) -> list[Path]:
    import matplotlib as mpl

    mpl.use("Agg")
    from optuna.visualization import matplotlib as visualization

    def importances(study: optuna.Study) -> Any:
        axes = visualization.plot_param_importances(study, evaluator=PedAnovaImportanceEvaluator())
        axes.set_title("Hyperparameter importances (PED-ANOVA: what distinguishes the best trials)")
        return axes

    plots: dict[str, Callable[[optuna.Study], Any]] = {
        "history": visualization.plot_optimization_history,
        "importances": importances,
        "parallel_coordinates": visualization.plot_parallel_coordinate,
    }
    return [_save(folder / f"{name}.png", draw, study) for name, draw in plots.items()]


def _save(path: Path, draw: Callable[[optuna.Study], Any], study: optuna.Study) -> Path:
    from matplotlib import pyplot as plt

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        axes = draw(study)
    axes.figure.set_size_inches(PLOT_SIZE)
    with whole_file(path) as partial:
        axes.figure.savefig(partial, dpi=DOTS_PER_INCH, bbox_inches="tight")
    plt.close(axes.figure)
    return path
