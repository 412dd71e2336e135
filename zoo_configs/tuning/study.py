"""A study: trials in a storage that several processes share."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import optuna
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, GPSampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from tqdm import tqdm

from zoo_configs.arguments import hides_progress
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.experiments.config import ExperimentConfig, merge
from zoo_configs.files import whole_file
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.seeds import SeedStream, stream_seed
from zoo_configs.training.state import is_locked, lock
from zoo_configs.training.train import train_experiment
from zoo_configs.tuning.space import BASELINE, Parameter, first_values, sample_params
from zoo_configs.tuning.trial import PRUNED, ReportToTrial, score

JOURNAL = "journal.log"
STUDY, FOLDER = "study", "folder"
"""Attributes of a study: its subject and its folder."""
ERROR, REPEATS = "error", "repeats"
"""Attributes of a trial: the reason for its failure, and the numbers of the trials that it repeats."""
WARMUP = 2
"""Evaluations before a trial is pruned; the first ones precede the agent's own steps."""


@dataclass(frozen=True)
class Search:
    """
    Subject and settings of a study.

    :param name: Name of the study
    :param folder: Its folder, shared by all processes: trials, demonstrations and by default the storage
    :param experiment: The experiment; its values are the first trial
    :param space: Its search space
    :param seed: Seed of models, environments and sampler
    :param options: Options of a trial's training
    :param n_trials: Number of trials of all processes
    :param sampler: ``"tpe"``, ``"random"`` or ``"gp"``
    :param pruner: ``"median"``, ``"halving"`` or ``"none"``
    :param n_startup_trials: Number of trials that are sampled at random, and of complete trials before
        another one is pruned
    :param storage: URL of a database, None for a journal in the folder
    :param device: PyTorch device
    :param gym_packages: Packages that register the environment, in addition to ours
    """

    name: str
    folder: Path
    experiment: ExperimentConfig
    space: tuple[Parameter, ...]
    seed: int
    options: TrainingOptions
    n_trials: int
    sampler: str = "tpe"
    pruner: str = "median"
    n_startup_trials: int = 10
    storage: str | None = None
    device: str = "auto"
    gym_packages: tuple[str, ...] = ()

    @property
    def storage_name(self) -> str:
        """Name of the storage for ``optuna-dashboard``."""
        return self.storage or str(self.folder / JOURNAL)

    def about(self) -> str:
        """Return everything that the meaning of a trial depends on, as JSON."""
        content = {
            "env": self.experiment.env_id,
            "algo": self.experiment.algo,
            "baseline": self.experiment.baseline,
            "preset": self.experiment.preset,
            "benchmark": self.experiment.benchmark,
            "hyperparams": self.experiment.hyperparams,
            "space": [list(parameter) for parameter in self.space],
            "seed": self.seed,
            "options": self.options.plain(),
        }
        return json.dumps(content, sort_keys=True)


def open_study(search: Search) -> optuna.Study:
    """
    Create a study, or join it.

    :param search: The study's subject and settings
    :return: The study
    :raises CommandError: if the storage cannot be opened, or its study has another subject, another folder or
        belongs to another program
    """
    search.folder.mkdir(parents=True, exist_ok=True)
    with _alone(search.folder):
        with refused(f"--storage: {search.storage_name} cannot be opened"):
            study = optuna.create_study(
                storage=_storage(search),
                study_name=search.name,
                direction="maximize",
                pruner=_pruner(search),
                load_if_exists=True,
            )
        if STUDY not in study.user_attrs:
            _check_new(search, study)
            study.set_user_attr(FOLDER, _identify(search.folder))
            study.enqueue_trial(first_values(search.space, search.experiment), {BASELINE: True})
            study.set_user_attr(STUDY, search.about())
    if others := _differences(study.user_attrs[STUDY], search.about()):
        names = ", ".join(others)
        raise CommandError(f"study {search.name} exists with other {names}. Use another --study-name.")
    if study.user_attrs[FOLDER] != _identify(search.folder):
        raise CommandError(f"study {search.name} has another folder than {search.folder}. Share that folder.")
    return study


def _check_new(search: Search, study: optuna.Study) -> None:
    """
    Check that a study without our attributes is new.

    :raises CommandError: if another program has begun it
    """
    trials = len(study.get_trials(deepcopy=False))
    if FOLDER in study.user_attrs:  # created by a process that was killed
        return
    if trials or study.user_attrs or study.directions != [StudyDirection.MAXIMIZE]:
        directions = [direction.name.lower() for direction in study.directions]
        raise CommandError(
            f"--study-name must be a new study or one of bulletarm-zoo tune, got {search.name} of another "
            f"program ({trials} trials, directions {directions}). Use another --study-name."
        )


def work(search: Search, study: optuna.Study, progress: bool | None = False) -> None:
    """
    Train trials until the study has ``n_trials``. Other processes can do so at the same time.

    :param search: The study's subject and settings
    :param study: The study
    :param progress: Whether to show a bar of the study's finished trials; None shows it on a terminal
    """
    number, hidden, done = search.n_trials, hides_progress(progress), _count_finished(study)
    with tqdm(total=number, initial=done, unit="trial", disable=hidden) as bar:
        while (claimed := _next_trial(search, study)) is not None:
            trial, claim = claimed
            with claim:
                _run(search, study, trial)
            bar.update(_count_finished(study) - bar.n)


def retried(trials: Iterable[FrozenTrial]) -> set[int]:
    """
    Return the numbers of the trials that another one repeats.

    :param trials: All trials of a study
    :return: The trials that do not count
    """
    return {number for trial in trials for number in trial.user_attrs.get(REPEATS, ())}


def _count_finished(study: optuna.Study) -> int:
    """Return the number of finished trials of all processes."""
    trials = study.get_trials(deepcopy=False)
    return len({trial.number for trial in trials if trial.state.is_finished()} - retried(trials))


def trial_folder(search: Search, trial: FrozenTrial) -> Path:
    """
    Return the run folder of a trial, which a repeated trial shares with the first one.

    :param search: The study's subject and settings
    :param trial: The trial
    :return: The folder
    """
    first = [*trial.user_attrs.get(REPEATS, ()), trial.number][0]
    return search.folder / f"trial_{first:04d}"


def _next_trial(search: Search, study: optuna.Study) -> tuple[optuna.Trial, IO[str]] | None:
    """Return the next trial and its locked file, None if there are enough trials."""
    with _alone(search.folder):
        _retry_stale(search, study)
        trials = study.get_trials(deepcopy=False)
        begun = [trial for trial in trials if trial.state is not TrialState.WAITING]
        again = len(retried(trials))
        if len(begun) - again >= search.n_trials:
            return None
        study.sampler = _sampler(search, len(begun) - again)
        trial = study.ask()
        claim = _claim_file(search, study.get_trials(deepcopy=False)[trial.number]).open("a")
        lock(claim)
        return trial, claim


def _retry_stale(search: Search, study: optuna.Study) -> None:
    """Queue running trials again whose process has died, which leaves their file unlocked."""
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if not is_locked(_claim_file(search, trial)):
            study.tell(trial.number, state=TrialState.FAIL)
            repeats = [*trial.user_attrs.get(REPEATS, ()), trial.number]
            again = optuna.trial.create_trial(
                state=TrialState.WAITING,
                params=trial.params,
                distributions=trial.distributions,
                user_attrs={**trial.user_attrs, REPEATS: repeats},
            )
            study.add_trial(again)


def _claim_file(search: Search, trial: FrozenTrial) -> Path:
    return trial_folder(search, trial).with_suffix(".lock")


def _run(search: Search, study: optuna.Study, trial: optuna.Trial) -> None:
    folder = trial_folder(search, study.get_trials(deepcopy=False)[trial.number])
    try:
        sampled = sample_params(search.experiment, search.space, trial)
        experiment = replace(
            search.experiment,
            hyperparams=merge(search.experiment.hyperparams, sampled),
            overrides=merge(search.experiment.overrides, sampled),
        )
        run = train_experiment(
            experiment,
            search.seed,
            search.device,
            search.folder,
            options=search.options,
            at=folder,
            gym_packages=search.gym_packages,
            callbacks=[ReportToTrial(trial, folder)],
        )
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
    """
    Describe a trial in one line.

    :param trial: The trial
    :return: Its number, result and values
    """
    ended = f"{trial.value:.3f}" if trial.value is not None else trial.user_attrs.get(ERROR, "")
    values = ", ".join(f"{name} {_short(value)}" for name, value in trial.params.items())
    return f"trial {trial.number}: {trial.state.name.lower()} {ended} ({values})"


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _storage(search: Search) -> BaseStorage:
    if search.storage is None or search.storage.endswith(".log"):
        return JournalStorage(JournalFileBackend(search.storage_name))
    return RDBStorage(search.storage)


def _sampler(search: Search, number: int) -> BaseSampler:
    """Build the sampler of a trial. Its seed depends on the number of the trial, not on the process."""
    seed = stream_seed(search.seed, SeedStream.SAMPLER, number)
    if search.sampler == "random" or number < search.n_startup_trials:
        return RandomSampler(seed=seed)
    if search.sampler == "gp":
        return GPSampler(seed=seed, n_startup_trials=search.n_startup_trials)
    return TPESampler(seed=seed, n_startup_trials=search.n_startup_trials, constant_liar=True)


class StartupPruner(BasePruner):
    """
    Pruner that waits for a number of complete trials.

    :param pruner: The pruner that decides then
    :param n_startup_trials: Number of complete trials
    """

    def __init__(self, pruner: BasePruner, n_startup_trials: int) -> None:
        self.pruner, self.n_startup_trials = pruner, n_startup_trials

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """
        Return True if a trial is to be pruned.

        :param study: Its study
        :param trial: The trial
        """
        complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        return len(complete) >= self.n_startup_trials and self.pruner.prune(study, trial)


def _pruner(search: Search) -> BasePruner:
    if search.pruner == "none":
        return NopPruner()
    halving, median = SuccessiveHalvingPruner(), MedianPruner(n_startup_trials=0, n_warmup_steps=WARMUP)
    return StartupPruner(halving if search.pruner == "halving" else median, search.n_startup_trials)


def _differences(begun: str, wanted: str) -> list[str]:
    left, right = json.loads(begun), json.loads(wanted)
    return [name for name in left if left[name] != right.get(name)]


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
