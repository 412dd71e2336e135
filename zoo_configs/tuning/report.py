"""Results of a study: the best hyperparameters as YAML, and plots."""

import warnings
from pathlib import Path
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.importance import PedAnovaImportanceEvaluator
from optuna.trial import FrozenTrial, TrialState

from zoo_configs.errors import CommandError
from zoo_configs.files import whole_file, write_yaml
from zoo_configs.training.runs import load_run
from zoo_configs.tuning.study import ERROR, Search, describe, retried, trial_folder

BEST_FILE = "best.yml"
DOTS_PER_INCH = 120
PLOT_SIZE = (9.0, 5.0)
"""Width and height in inches."""
IMPORTANCES_TITLE = "Hyperparameter importances (PED-ANOVA: what distinguishes the best trials)"
LEAST_TRIALS = 2
"""Complete trials that the plots need."""


def write_report(search: Search, study: optuna.Study) -> list[Path]:
    """Write and return the results of a study so far: none without a complete trial."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        return []
    best = _write_best(search, study.best_trial)
    return [best, *_draw(search.folder, study)] if len(complete) >= LEAST_TRIALS else [best]


def summary(study: optuna.Study) -> str:
    """Return the number of a study's trials by state, without repeated ones."""
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
    """Raise ``CommandError`` if a study has no complete trial, and no process is training one."""
    trials = study.get_trials(deepcopy=False)
    if any(trial.state is TrialState.COMPLETE or not trial.state.is_finished() for trial in trials):
        return
    errors = [trial.user_attrs[ERROR] for trial in trials if ERROR in trial.user_attrs]
    why = f". First error: {errors[0]}" if errors else ""
    raise CommandError(f"study {search.name} has no complete trial of {len(trials)}{why}")


def _draw(folder: Path, study: optuna.Study) -> list[Path]:
    from optuna.visualization import matplotlib as visualization

    evaluator = PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        plots = {
            "history": visualization.plot_optimization_history(study),
            "importances": visualization.plot_param_importances(study, evaluator=evaluator),
            "parallel_coordinates": visualization.plot_parallel_coordinate(study),
        }
    plots["importances"].set_title(IMPORTANCES_TITLE)
    return [_save(folder / f"{name}.png", axes) for name, axes in plots.items()]


def _save(path: Path, axes: Any) -> Path:
    from matplotlib import pyplot as plt

    axes.figure.set_size_inches(PLOT_SIZE)
    with whole_file(path) as partial:
        axes.figure.savefig(partial, dpi=DOTS_PER_INCH, bbox_inches="tight")
    plt.close(axes.figure)
    return path
