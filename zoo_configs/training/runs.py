"""Run folders in rl_zoo3's layout, ``<log folder>/<algo>/<env>_<number>``."""

import contextlib
import os
import shlex
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pandas as pd

from zoo_configs.arguments import key_value_words
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.experiments.config import ExperimentConfig
from zoo_configs.files import read_yaml, whole_file, write_yaml
from zoo_configs.provenance import commit, describe_hardware, versions
from zoo_configs.training.options import TrainingOptions, flag
from zoo_configs.training.state import RunStatus, run_status

RESOLVED_FILE = "hyperparams.yml"
SEED_PREFIX = "seed_"
"""Start of the names of a benchmark's run folders, ``<folder>/<task>/<baseline>/seed_<n>``."""
RUN_KEY = "run"
"""Key of the resolved file next to the environment's section; rl_zoo3 does not read it."""
EXPERIMENT_KEYS = ("algo", "baseline", "preset", "benchmark", "overrides", "flags")
"""Fields of the experiment below this key."""


class RunFile:
    """Path in the folder of a run, in which ``{env}`` stands for its environment."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, run: "Run", owner: type["Run"]) -> Path:
        return run.folder / self.name.format(env=env_folder_name(run.experiment.env_id))


@dataclass(frozen=True)
class Run:
    """
    A training run on disk.

    :param seed: Seed of model and environments
    :param gym_packages: Packages that register the environment, in addition to ours
    """

    folder: Path
    experiment: ExperimentConfig
    seed: int = 0
    device: str = "auto"
    options: TrainingOptions = field(default_factory=TrainingOptions)
    gym_packages: tuple[str, ...] = ()

    resolved_file = RunFile(RESOLVED_FILE)
    """The YAML file that rl_zoo3 reads as its ``--conf-file``."""
    config_file = RunFile("{env}/config.yml")
    """Hyperparameters that rl_zoo3's ``enjoy`` reads."""
    statistics_file = RunFile("{env}/vecnormalize.pkl")
    """Statistics of ``VecNormalize``."""
    last_model = RunFile("{env}.zip")
    """The model at the end of the training."""
    best_model = RunFile("best_model.zip")
    """The model of the best periodic evaluation."""
    checkpoint_folder = RunFile("checkpoints")
    """Folder of the checkpoints."""
    evaluations_file = RunFile("evaluations.npz")
    """Periodic evaluations, in Stable-Baselines3's format."""
    training_log = RunFile("training.csv")
    """Values that the algorithm logged with its updates."""
    certificate = RunFile("certificate.yml")
    """Checksums of its first updates."""
    curve_file = RunFile("learning_curve.png")
    """Figure of the evaluations."""

    @property
    def n_timesteps(self) -> int:
        """Number of time steps to train."""
        wanted = self.options.n_timesteps
        return wanted if wanted > 0 else int(self.experiment.hyperparams["n_timesteps"])

    @property
    def has_model(self) -> bool:
        """True if a model is saved."""
        return self.best_model.is_file() or self.last_model.is_file()

    @property
    def status(self) -> RunStatus:
        """Its status."""
        return run_status(self.folder)


def env_folder_name(env_id: str) -> str:
    """Return an id as a part of file names, with dashes instead of slashes, as in rl_zoo3."""
    return env_id.replace("/", "-")


def claim_run_folder(log_folder: Path, env_id: str) -> Path:
    """Create the next numbered folder in an algorithm's log folder. Simultaneous runs get different ones."""
    start = f"{env_folder_name(env_id)}_"
    ends = [path.name.removeprefix(start) for path in log_folder.glob(f"{start}*")]
    number = max(map(int, filter(str.isdecimal, ends)), default=0)
    while True:
        number += 1
        with contextlib.suppress(FileExistsError):  # another process was first
            (folder := log_folder / f"{start}{number}").mkdir(parents=True)
            return folder


def write_resolved(run: Run) -> None:
    """Write the configuration of a run, in the form of rl_zoo3's ``--conf-file`` and for its ``enjoy``."""
    experiment = run.experiment
    about = {
        **{name: getattr(experiment, name) for name in EXPERIMENT_KEYS},
        "seed": run.seed,
        "device": run.device,
        "options": asdict(run.options),
        "gym_packages": list(run.gym_packages),
        "commit": commit(),
        "versions": versions(),
        "machine": describe_hardware(run.device),
    }
    write_yaml(run.config_file, dict(sorted(experiment.hyperparams.items())))
    write_yaml(run.resolved_file, {RUN_KEY: about, experiment.env_id: experiment.hyperparams})


def load_run(folder: Path) -> Run:
    """Read a run folder; raise ``CommandError`` if it is not a run folder of this version."""
    path = folder / RESOLVED_FILE
    if not path.is_file():
        raise CommandError(f"{folder} is not a run folder: it has no {RESOLVED_FILE}")
    content = read_yaml(path)
    with refused(f"{path} cannot be read"):
        about = content.pop(RUN_KEY)
        ((env_id, hyperparams),) = content.items()
        named = {name: about[name] for name in EXPERIMENT_KEYS}
        experiment = ExperimentConfig(env_id=env_id, hyperparams=dict(hyperparams), **named)
        options, packages = TrainingOptions(**about["options"]), tuple(about["gym_packages"])
        return Run(folder, experiment, about["seed"], about["device"], options, packages)


def find_runs(log_folder: Path, env_id: str | None = None) -> list[Run]:
    """
    Return the runs of all algorithms in a folder of ``train`` or ``benchmark``, oldest first.

    A folder that cannot be read is skipped with a message. ``env_id`` None selects all environments.
    """
    name = "*" if env_id is None else env_folder_name(env_id)
    patterns = (f"*/{name}_*/{RESOLVED_FILE}", f"*/*/{SEED_PREFIX}*/{RESOLVED_FILE}")
    files = [path for pattern in patterns for path in log_folder.glob(pattern)]
    runs = []
    for path in sorted(files, key=lambda path: (path.stat().st_mtime_ns, path.parent.name)):
        try:
            runs.append(load_run(path.parent))
        except CommandError as error:
            print(f"skipped: {reason(error)}", file=sys.stderr)
    return [run for run in runs if env_id in (None, run.experiment.env_id)]


def clear(run: Run) -> None:
    """Remove the files of a run that was killed before its first checkpoint and starts again."""
    reports = [run.evaluations_file, run.training_log, run.certificate, run.curve_file]
    monitors = run.folder.glob("*.monitor.csv")
    for path in (*reports, *monitors, run.best_model, run.last_model, run.statistics_file):
        path.unlink(missing_ok=True)


def copy_statistics(run: Run) -> None:
    """Copy the normalisation statistics, if any, of the model that a run starts from to its folder."""
    source = Path(run.options.trained_agent).parent / run.statistics_file.relative_to(run.folder)
    if run.options.trained_agent and source.is_file():
        with whole_file(run.statistics_file) as partial:
            shutil.copyfile(source, partial)


def cut_monitor_files(run: Run, steps: Sequence[int]) -> None:
    """
    Remove the episodes that ended after a run's checkpoint from its monitor files.

    :param steps: Steps of each environment at the checkpoint
    """
    for rank, limit in enumerate(steps):
        path = run.folder / f"{rank}.monitor.csv"
        if path.is_file():
            with refused(f"{path} is damaged"):
                ends = pd.read_csv(path, comment="#")["l"].cumsum()
            kept = path.read_bytes().splitlines(keepends=True)[: 2 + int((ends <= limit).sum())]
            os.truncate(path, sum(map(len, kept)))  # the open file appends


@dataclass(frozen=True)
class Origin:
    """
    How an agent was trained.

    :param minutes: Training time, None if unknown because the run is being trained or was killed
    :param command: Command line that trains it again
    :param commit: Commit of the code
    :param date: Date of the end of the training
    """

    minutes: float | None
    command: str
    commit: str
    date: str
    machine: str
    versions: Mapping[str, str]


def origin_of(run: Run) -> Origin:
    """Read how a run was trained; raise ``CommandError`` if its folder cannot be read."""
    with refused(f"{run.resolved_file} cannot be read"):
        about: dict[str, Any] = read_yaml(run.resolved_file)[RUN_KEY]
    how = run.status
    return Origin(
        minutes=round(how.seconds / 60, 1) if how.until else None,
        command=repeating_command(run),
        commit=about["commit"],
        date=day(how.until or (how.since or time.time()) + how.seconds),
        machine=about["machine"],
        versions=about["versions"],
    )


def repeating_command(run: Run) -> str:
    """Return the command line that trains a run again."""
    experiment = run.experiment
    words = ["bulletarm-zoo", "train", "--env", experiment.env_id, "--seed", str(run.seed)]
    if experiment.baseline is None:
        words += ["--conf-file", str(run.resolved_file), "--algo", experiment.algo]
    else:
        words += ["--baseline", experiment.baseline, "--preset", str(experiment.preset)]
        words += ["--benchmark", experiment.benchmark] if experiment.benchmark else []
    words += [] if run.device == "auto" else ["--device", run.device]
    words += ["--gym-packages", ",".join(run.gym_packages)] if run.gym_packages else []
    words += _options(run)
    env_kwargs = experiment.overrides.get("env_kwargs", {})
    others = {name: value for name, value in experiment.overrides.items() if name != "env_kwargs"}
    words += ["--env-kwargs", *key_value_words(env_kwargs)] if env_kwargs else []
    words += ["-params", *key_value_words(others)] if others else []
    return shlex.join(words)


def _options(run: Run) -> Iterator[str]:
    """Yield the options that differ from the preset's."""
    preset = asdict(TrainingOptions.of(run.experiment))
    for name, value in asdict(run.options).items():
        if value != preset[name]:
            yield flag(name)
            yield from () if value is True else (str(value),)


def day(seconds: float) -> str:
    """Return the date (UTC) of a time in seconds since 1970."""
    return datetime.fromtimestamp(seconds, timezone.utc).date().isoformat()
