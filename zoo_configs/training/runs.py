"""Run folders, laid out as rl_zoo3 does: ``<log folder>/<algo>/<env>_<number>``, with one resolved YAML."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3.utils import get_latest_run_id, get_saved_hyperparams

from zoo_configs.cells.cell import Cell
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.files import remove_empty, whole_file
from zoo_configs.provenance import commit, describe_hardware, versions
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.state import Standing, standing

RESOLVED_FILE = "hyperparams.yml"
CONFIG_FILE = "config.yml"  # rl_zoo3's
EVALUATIONS_FILE = "evaluations.npz"
TRAINING_LOG_FILE = "training.csv"
BEST_MODEL_FILE = "best_model.zip"
CHECKPOINT_FOLDER = "checkpoints"
# In the log folder, for all its runs.
# Of a benchmark's run folders, <folder>/<task>/<baseline>/seed_<n>.
SEED_PREFIX = "seed_"
CURVE_FILE = "learning_curve.png"
# The key of the resolved file beside the environment's section; rl_zoo3 does not read it.
RUN_KEY = "run"


@dataclass(frozen=True)
class Run:
    """
    A training run on disk.

    :param folder: Its folder
    :param cell: What was trained
    :param seed: Of model and environments
    :param device: PyTorch device
    :param options: How it was trained
    :param gym_packages: Packages that register the environment, besides our own
    """

    folder: Path
    cell: Cell
    seed: int = 0
    device: str = "auto"
    options: TrainingOptions = field(default_factory=TrainingOptions)
    gym_packages: tuple[str, ...] = ()

    @property
    def number(self) -> int:
        """Number of the run among those of its algorithm and environment, 0 for a folder named otherwise."""
        digits = self.folder.name.removeprefix(f"{env_folder_name(self.cell.env_id)}_").partition("_")[0]
        return int(digits) if digits.isdigit() else 0

    @property
    def resolved_file(self) -> Path:
        """The YAML that rl_zoo3 reads as its ``--conf-file``."""
        return self.folder / RESOLVED_FILE

    @property
    def params_folder(self) -> Path:
        """Folder in which rl_zoo3 keeps the configuration."""
        return self.folder / env_folder_name(self.cell.env_id)

    @property
    def last_model(self) -> Path:
        """The model as training left it."""
        return self.folder / f"{env_folder_name(self.cell.env_id)}.zip"

    @property
    def best_model(self) -> Path:
        """The model that did best in a periodic evaluation."""
        return self.folder / BEST_MODEL_FILE

    @property
    def has_model(self) -> bool:
        """Whether there is something to act with."""
        return self.best_model.is_file() or self.last_model.is_file()

    @property
    def checkpoint_folder(self) -> Path:
        """Folder of what training goes on from."""
        return self.folder / CHECKPOINT_FOLDER

    @property
    def evaluations_file(self) -> Path:
        """Periodic evaluations, in Stable-Baselines3's format."""
        return self.folder / EVALUATIONS_FILE

    @property
    def training_log(self) -> Path:
        """What the algorithm logged of its updates."""
        return self.folder / TRAINING_LOG_FILE

    @property
    def standing(self) -> Standing | None:
        """How it stands: running, done, failed or killed; None if no training has begun."""
        return standing(self.folder)

    def saved_hyperparams(self) -> tuple[dict[str, Any], str | None]:
        """
        Hyperparameters as trained with, prepared by rl_zoo3 for rebuilding the environment.

        :return: The hyperparameters and the folder of normalisation statistics
        :raises CommandError: if they are missing
        """
        if not (self.params_folder / CONFIG_FILE).is_file():
            raise CommandError(f"{self.folder} is not whole: {self.params_folder / CONFIG_FILE} is missing")
        with refused(f"{self.params_folder / CONFIG_FILE} cannot be read"):
            hyperparams, stats_path = get_saved_hyperparams(str(self.params_folder), test_mode=True)
        return dict(hyperparams), stats_path


def env_folder_name(env_id: str) -> str:
    """
    An id as part of a file name, as rl_zoo3 spells it.

    :param env_id: Id of the environment
    :return: The id with dashes for slashes
    """
    return env_id.replace("/", "-")


def claim_run_folder(log_folder: Path, env_id: str, suffix: str = "") -> Path:
    """
    Create the next numbered run folder; two runs that start together get different ones.

    :param log_folder: Folder of the algorithm's runs
    :param env_id: Id of the environment
    :param suffix: What follows the number
    :return: The new, empty folder
    """
    log_folder.mkdir(parents=True, exist_ok=True)
    name = env_folder_name(env_id)
    number = get_latest_run_id(str(log_folder), name)
    while True:
        number += 1
        folder = log_folder / f"{name}_{number}{suffix}"
        try:
            folder.mkdir()  # atomic: fails if another process was first
        except FileExistsError:
            continue
        return folder


def write_resolved(run: Run) -> Path:
    """
    Write a run's resolved hyperparameters, in the form that rl_zoo3 takes as ``--conf-file``.

    :param run: The run
    :return: The file
    """
    about = {
        "algo": run.cell.algo,
        "baseline": run.cell.baseline,
        "preset": run.cell.preset,
        "benchmark": run.cell.benchmark,
        "seed": run.seed,
        "device": run.device,
        "options": run.options.plain(),
        "gym_packages": list(run.gym_packages),
        "commit": commit(),
        "versions": versions(),
        "machine": describe_hardware(run.device),
    }
    path = run.resolved_file
    with whole_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        yaml.safe_dump({RUN_KEY: about, run.cell.env_id: run.cell.hyperparams}, file, sort_keys=False)
    return path


def load_run(folder: Path) -> Run:
    """
    Read a run folder.

    :param folder: The folder
    :return: The run
    :raises CommandError: if it is not a run folder of this command line
    """
    path = folder / RESOLVED_FILE
    if not path.is_file():
        raise CommandError(f"{folder} is no run folder: it has no {RESOLVED_FILE}")
    with refused(f"{path} cannot be read"):
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        about = content.pop(RUN_KEY)
        ((env_id, hyperparams),) = content.items()
        named = {key: about.get(key) for key in ("baseline", "preset", "benchmark")}
        cell = Cell(about["algo"], env_id, dict(hyperparams), {}, **named)
        options = TrainingOptions.from_plain(about["options"])
        packages = tuple(about.get("gym_packages", ()))
        return Run(folder, cell, about["seed"], about["device"], options, packages)


def find_runs(log_folder: Path, env_id: str | None = None) -> list[Run]:
    """
    Runs in a log folder; one that cannot be read is told and left out.

    :param log_folder: The folder given as ``-f`` to ``train`` or ``benchmark``
    :param env_id: Id of the environment, default all
    :return: The runs of all algorithms, oldest first
    """
    name = "*" if env_id is None else env_folder_name(env_id)
    patterns = (f"*/{name}_*/{RESOLVED_FILE}", f"*/*/{SEED_PREFIX}*/{RESOLVED_FILE}")
    files = [path for pattern in patterns for path in log_folder.glob(pattern)]
    newest_last = sorted(files, key=lambda path: (path.stat().st_mtime_ns, path.parent.name))
    runs = []
    for path in newest_last:
        try:
            runs.append(load_run(path.parent))
        except CommandError as error:
            print(f"left out: {reason(error)}", file=sys.stderr)
    return [run for run in runs if env_id in (None, run.cell.env_id)]


def clear(run: Run) -> None:
    """
    Remove what a run has left that was killed before its first checkpoint, and begins anew.

    :param run: The run
    """
    reports = [run.evaluations_file, run.training_log, run.folder / CURVE_FILE]
    monitors = run.folder.glob("*.monitor.csv")
    for path in (*reports, *monitors, run.best_model, run.last_model):
        path.unlink(missing_ok=True)


def discard_if_fruitless(run: Run, made: Iterable[Path]) -> None:
    """
    Remove the folder of a run that failed before it had a model or a checkpoint.

    :param run: The run
    :param made: Folders above it that were made for it, innermost first; those that are empty go too
    """
    from sb3_extensions.common.checkpoint import latest_checkpoint  # loads PyTorch

    if run.has_model or latest_checkpoint(run.checkpoint_folder) is not None:
        return
    shutil.rmtree(run.folder, ignore_errors=True)
    remove_empty(made)
