"""A study: trials in a storage that several processes share, its best hyperparameters and its plots."""

import fcntl
import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import numpy as np
import optuna
from matplotlib import pyplot as plt
from optuna.exceptions import ExperimentalWarning
from optuna.importance import PedAnovaImportanceEvaluator
from optuna.pruners import MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import matplotlib as visualization
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from zoo_configs.drawing.curves import load_curve
from zoo_configs.environments import SeedStream, stream_seed
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.files import whole_file, write_yaml
from zoo_configs.training.runs import Run, load_run
from zoo_configs.training.state import is_locked, lock
from zoo_configs.training.train import train_run
from zoo_configs.tuning.space import BASELINE, Parameter, first_values, sample_params

STUDY, FOLDER = "study", "folder"
"""Attributes of a study: its subject and its folder."""
ERROR, REPEATS, PRUNED = "error", "repeats", "pruned"
"""Attributes of a trial: the reason for its failure, the trials that it repeats, and that it was pruned."""
WARMUP = 2
"""Evaluations before a trial is pruned; the first ones precede the agent's own steps."""
BEST_FILE = "best.yml"
DOTS_PER_INCH = 120
PLOT_SIZE = (9.0, 5.0)
"""Width and height in inches."""
IMPORTANCES_TITLE = "Hyperparameter importances (PED-ANOVA: what distinguishes the best trials)"
LEAST_TRIALS = 2
"""Complete trials that the plots need."""


@dataclass(frozen=True)
class Search:
    """
    Subject and settings of a study.

    :param run: Run of which the trials differ in their hyperparameters; its values are the first trial. Its
        folder is that of the study, shared by all processes: trials and by default the storage
    :param space: Search space of the experiment
    :param n_trials: Number of trials of all processes
    :param pruner: ``"median"`` or ``"none"``
    :param n_startup_trials: Number of trials that are sampled at random, and of complete trials before
        another one is pruned
    :param storage: URL of a database, None for a journal in the folder
    """

    name: str
    run: Run
    space: tuple[Parameter, ...]
    n_trials: int
    pruner: str = "median"
    n_startup_trials: int = 10
    storage: str | None = None

    @property
    def storage_name(self) -> str:
        """Name of the storage for ``optuna-dashboard``."""
        return self.storage or str(self.run.folder / "journal.log")

    def about(self) -> dict[str, Any]:
        """Return everything that the meaning of a trial depends on, as plain data."""
        names = ("env_id", "algo", "baseline", "preset", "benchmark", "hyperparams")
        experiment = {name: getattr(self.run.experiment, name) for name in names}
        options, seed = asdict(self.run.options), self.run.seed
        content = {**experiment, "space": self.space, "seed": seed, "options": options}
        return dict(json.loads(json.dumps(content)))


def open_study(search: Search) -> optuna.Study:
    """Create a study, or join it; raise ``CommandError`` if it is another one or cannot be opened."""
    search.run.folder.mkdir(parents=True, exist_ok=True)
    with _alone(search.run.folder):
        with refused(f"--storage: {search.storage_name} cannot be opened"):
            is_median = search.pruner == "median"
            is_journal = search.storage is None or search.storage.endswith(".log")
            journal = JournalStorage(JournalFileBackend(search.storage_name)) if is_journal else None
            study = optuna.create_study(
                storage=journal or search.storage,
                study_name=search.name,
                direction="maximize",
                pruner=MedianPruner(search.n_startup_trials, WARMUP) if is_median else NopPruner(),
                load_if_exists=True,
            )
        if STUDY not in study.user_attrs:
            _check_new(search, study)
            study.set_user_attr(FOLDER, _identify(search.run.folder))
            study.enqueue_trial(first_values(search.space, search.run.experiment), {BASELINE: True})
            study.set_user_attr(STUDY, search.about())
    begun = study.user_attrs[STUDY]
    if others := [name for name, value in search.about().items() if begun.get(name) != value]:
        different = f"study {search.name} exists with other {', '.join(others)}"
        raise CommandError(f"{different}. Use another --study-name.")
    if study.user_attrs[FOLDER] != _identify(search.run.folder):
        raise CommandError(f"study {search.name} has another folder than {search.run.folder}. Share it.")
    return study


def _check_new(search: Search, study: optuna.Study) -> None:
    """Check that no other program has begun a study without our attributes, and the folder has no trials."""
    trials = len(study.get_trials(deepcopy=False))
    is_new = not trials and not study.user_attrs and study.directions == [StudyDirection.MAXIMIZE]
    if not is_new and FOLDER not in study.user_attrs:  # with it, a process of ours was killed
        constraint = "a new study or one of bulletarm-zoo tune"
        raise CommandError(f"--study-name must be {constraint}, got {search.name} with {trials} trials")
    if any(search.run.folder.glob("trial_*")):
        raise CommandError(f"--storage must be that of the trials in {search.run.folder}, got a new study")


def work(search: Search, study: optuna.Study, progress: bool = False) -> None:
    """Train trials until the study has ``n_trials``. Other processes can do so at the same time."""
    number, done = search.n_trials, _count_finished(study)
    with tqdm(total=number, initial=done, unit="trial", disable=not progress) as bar:
        while (claimed := _next_trial(search, study)) is not None:
            trial, claim = claimed
            with claim:
                _run(search, study, trial)
            bar.update(_count_finished(study) - bar.n)


def counted(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials of all processes without those that another one repeats."""
    trials = study.get_trials(deepcopy=False)
    repeated = {number for trial in trials for number in trial.user_attrs.get(REPEATS, ())}
    return [trial for trial in trials if trial.number not in repeated]


def _count_finished(study: optuna.Study) -> int:
    return sum(trial.state.is_finished() for trial in counted(study))


def trial_folder(search: Search, trial: optuna.Trial | FrozenTrial) -> Path:
    """Return the run folder of a trial, which a repeated trial shares with the first one."""
    first = [*trial.user_attrs.get(REPEATS, ()), trial.number][0]
    return search.run.folder / f"trial_{first:04d}"


def _next_trial(search: Search, study: optuna.Study) -> tuple[optuna.Trial, IO[str]] | None:
    """Return the next trial and its locked file, None if there are enough trials."""
    with _alone(search.run.folder):
        _retry_stale(search, study)
        begun = sum(trial.state is not TrialState.WAITING for trial in counted(study))
        if begun >= search.n_trials:
            return None
        seed = stream_seed(search.run.seed, SeedStream.SAMPLER, begun)  # whatever the process
        study.sampler = TPESampler(seed=seed, n_startup_trials=search.n_startup_trials, constant_liar=True)
        trial = study.ask()
        claim = _claim_file(search, trial).open("a")
        lock(claim)
        return trial, claim


def _retry_stale(search: Search, study: optuna.Study) -> None:
    """Queue running trials again whose process has died, which leaves their file unlocked."""
    known = {trial.number for trial in counted(study)}
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if is_locked(_claim_file(search, trial)):
            continue
        if trial.number in known:  # else a process was killed between the two operations
            repeats = [*trial.user_attrs.get(REPEATS, ()), trial.number]
            again = optuna.trial.create_trial(
                state=TrialState.WAITING,
                params=trial.params,
                distributions=trial.distributions,
                user_attrs={**trial.user_attrs, REPEATS: repeats},
                system_attrs=trial.system_attrs,  # values of the baseline that were not yet suggested
            )
            study.add_trial(again)
        study.tell(trial.number, state=TrialState.FAIL)


def _claim_file(search: Search, trial: optuna.Trial | FrozenTrial) -> Path:
    return trial_folder(search, trial).with_suffix(".lock")


def _run(search: Search, study: optuna.Study, trial: optuna.Trial) -> None:
    experiment = search.run.experiment
    try:
        sampled = sample_params(experiment, search.space, trial)
        folder = trial_folder(search, trial)
        run = replace(search.run, folder=folder, experiment=experiment.overridden(sampled))
        train_run(run, [ReportToTrial(trial, run.evaluations_file)])
        if trial.user_attrs.get(PRUNED):
            study.tell(trial, state=TrialState.PRUNED)
        else:
            study.tell(trial, score(run))
    except Exception as error:  # an algorithm can raise any error for sampled values
        trial.set_user_attr(ERROR, reason(error))
        study.tell(trial, state=TrialState.FAIL)
    with tqdm.external_write_mode():  # above the bar
        print(describe(study.get_trials(deepcopy=False)[trial.number]), flush=True)


def describe(trial: FrozenTrial) -> str:
    """Return number, result and values of a trial in one line."""
    ended = f"{trial.value:.3f}" if trial.value is not None else trial.user_attrs.get(ERROR, "")
    short = {name: f"{v:.3g}" if isinstance(v, float) else v for name, v in trial.params.items()}
    values = ", ".join(f"{name} {value}" for name, value in short.items())
    return f"trial {trial.number}: {trial.state.name.lower()} {ended} ({values})"


def _identify(folder: Path) -> str:
    """Return an identifier that distinguishes a folder from one with the same path on another machine."""
    path = folder / ".identity"
    if not path.is_file():
        with whole_file(path) as partial:
            partial.write_text(uuid4().hex)
    return path.read_text()


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Let other processes of the study wait."""
    with (folder / ".lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


class ReportToTrial(BaseCallback):
    """Callback that reports each evaluation of a run to its trial, and ends a pruned trial."""

    def __init__(self, trial: optuna.Trial, evaluations: Path) -> None:
        super().__init__()
        self.trial, self.path = trial, evaluations
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
    """Return the mean success, or mean return without success, of the second half of a run's evaluations."""
    success = load_curve(run.evaluations_file).success
    return float(np.mean(success[len(success) // 2 :]))


def write_report(search: Search, study: optuna.Study) -> list[Path]:
    """Write and return the results of a study so far: none without a complete trial."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        return []
    best = _write_best(search, study.best_trial)
    return [best, *_draw(search.run.folder, study)] if len(complete) >= LEAST_TRIALS else [best]


def summary(study: optuna.Study) -> str:
    """Return the number of a study's trials by state, without repeated ones."""
    states = [trial.state.name.lower() for trial in counted(study)]
    return ", ".join(f"{states.count(name)} {name}" for name in dict.fromkeys(states))


def _write_best(search: Search, trial: FrozenTrial) -> Path:
    """Write the hyperparameters of the best trial for ``train --conf-file``."""
    run = load_run(trial_folder(search, trial))
    path = search.run.folder / BEST_FILE
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
    evaluator = PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        plots: dict[str, Any] = {
            "history": visualization.plot_optimization_history(study),
            "importances": visualization.plot_param_importances(study, evaluator=evaluator),
            "parallel_coordinates": visualization.plot_parallel_coordinate(study),
        }
    plots["importances"].set_title(IMPORTANCES_TITLE)
    for name, axes in plots.items():
        axes.figure.set_size_inches(PLOT_SIZE)
        with whole_file(folder / f"{name}.png") as partial:
            axes.figure.savefig(partial, dpi=DOTS_PER_INCH, bbox_inches="tight")
        plt.close(axes.figure)
    return [folder / f"{name}.png" for name in plots]
