"""Checks, size, training and status of the runs of a benchmark."""

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from sb3_extensions.replay.buffer import ExpertReplayBuffer
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.drawing.curves import load_curve
from zoo_configs.environments import make_env, tried_env
from zoo_configs.errors import CommandError, refused
from zoo_configs.files import check_writable
from zoo_configs.training.objects import parsed
from zoo_configs.training.runs import Run, load_run
from zoo_configs.training.state import LOCK_FILE, State, run_lock, set_status
from zoo_configs.training.train import check_same
from zoo_configs.training.validation import check_experiment, check_expert_data

Runner = Callable[[Sequence[Run], Callable[[], None]], None]
"""Function that trains runs and regularly calls another function."""
GIGABYTE = 1e9
PROCESS_GIGABYTES = 1.0
"""Memory of a process without its replay buffer."""
CHECKPOINTS = 3
"""Number of checkpoints on disk: two, and the one that is being written."""
INTERVAL = 2.0  # seconds between two readings of the folders
STATES = (State.DONE, State.RUNNING, State.WAITING, State.FAILED)
"""States of a run of a benchmark. A killed run waits to be resumed."""
ENDED = (State.DONE, State.FAILED)


class Size(NamedTuple):
    """Gigabytes of main memory and of the checkpoints of one run."""

    memory: float
    disk: float


def size_of(job: Run) -> Size:
    """Return the size of a run, which depends mainly on its replay buffer."""
    buffer = _buffer_gigabytes(job)
    return Size(PROCESS_GIGABYTES + buffer, CHECKPOINTS * buffer if job.options.save_freq else 0.0)


def _buffer_gigabytes(job: Run) -> float:
    """Return the size of the part of the replay buffer that the run fills."""
    hyperparams = parsed(job.experiment.hyperparams)
    default = getattr(algorithm_classes()[job.experiment.algo], "default_replay_buffer_class", None)
    cls = hyperparams.get("replay_buffer_class") or default
    if cls is None or not issubclass(cls, ExpertReplayBuffer):
        return 0.0
    kwargs: dict[str, Any] = hyperparams.get("replay_buffer_kwargs") or {}
    capacity, n_envs = int(hyperparams["buffer_size"]), int(hyperparams.get("n_envs", 1))
    env_kwargs = hyperparams.get("env_kwargs", {})
    with closing(make_env(job.experiment.env_id, env_kwargs)) as env, refused("replay buffer"):
        spaces = env.observation_space, env.action_space
        longest = int(getattr(getattr(env.unwrapped, "config", None), "max_steps", 0))
        # The buffer allocates no memory before the first transition.
        buffer = cls(capacity, *spaces, "cpu", n_envs=n_envs, gamma=0.99, seed=0, **kwargs)
    steps = job.n_timesteps + int(hyperparams.get("expert_episodes", 0)) * longest
    return float(buffer.table.nbytes) * min(1.0, steps / capacity) / GIGABYTE


def check_jobs(jobs: Sequence[Run], folder: Path) -> None:
    """Raise ``CommandError`` if a run cannot be trained, or the folder of the benchmark has other runs."""
    different = {}
    for experiment in {job.folder.parent: job.experiment for job in jobs}.values():
        check_experiment(experiment)
        made_of = (experiment.hyperparams.get(name) for name in ("env_kwargs", "expert_data"))
        different[json.dumps([experiment.env_id, *made_of], default=str)] = experiment
    for experiment in different.values():
        with tried_env(experiment.env_id, experiment.hyperparams.get("env_kwargs", {})) as env:
            check_expert_data(experiment, env)
    check_writable(folder / LOCK_FILE, "--log-folder")
    for job in jobs:
        if job.resolved_file.is_file():
            check_same(load_run(job.folder), job)


class Entry(NamedTuple):
    """State of one run, its latest success, and its machine or error."""

    state: State = State.WAITING
    success: str = ""
    detail: str = ""


class Overview:
    """States of all runs in the folder of a benchmark."""

    def __init__(self, jobs: Sequence[Run], folder: Path) -> None:
        self.folder = folder
        self.jobs = {str(job.folder.relative_to(folder)): job for job in jobs}
        self.entries = dict.fromkeys(self.jobs, Entry())

    def update(self) -> list[str]:
        """Read the folders of the runs that were not done, and return the names of those that changed."""
        before = self.entries
        read = {name: _read_entry(self.jobs[name]) for name in before if before[name].state != State.DONE}
        self.entries = before | read
        return [name for name, entry in read.items() if entry != before[name]]

    def of(self, *states: State) -> list[str]:
        """Return the names of the runs with one of some states."""
        return [name for name, entry in self.entries.items() if entry.state in states]

    def counts(self) -> str:
        """Return the number of runs with each state."""
        return ", ".join(f"{len(self.of(state))} {state.value}" for state in STATES)


def _read_entry(job: Run) -> Entry:
    try:
        found = job.status
    except CommandError as error:
        return Entry(State.FAILED, detail=str(error))
    success = ""
    with contextlib.suppress(CommandError, OSError):  # missing, or not yet visible in a shared folder
        curve = load_curve(job.evaluations_file)
        success = f"success {curve.success[-1]:.2f} at {curve.timesteps[-1]}"
    state = State.WAITING if found.state is State.KILLED else found.state
    details = {State.RUNNING: f"on {found.host}", State.FAILED: found.error}
    return Entry(state, success, details.get(found.state, ""))


@contextmanager
def shown(overview: Overview, progress: bool = False) -> Iterator[Callable[[], None]]:
    """Provide a function to call often, which prints the changes of an overview above a progress bar."""
    last = -INTERVAL
    with tqdm(total=len(overview.entries), unit="run", disable=not progress) as bar:

        def update() -> None:
            nonlocal last
            if time.monotonic() - last < INTERVAL:
                return
            last = time.monotonic()
            for name in overview.update():
                entry = overview.entries[name]
                parts = f"{entry.state.value} {name}", entry.success, entry.detail
                bar.write(f"[{overview.counts()}] {', '.join(filter(None, parts))}", file=sys.stderr)
            bar.n = len(overview.of(*ENDED))
            bar.set_postfix_str(overview.counts())

        yield update


def train_jobs(
    jobs: Sequence[Run], folder: Path, runner: Runner, retry_failed: bool = False, progress: bool = False
) -> Overview:
    """Train the runs that are not done, in a folder that is locked meanwhile, and return their status."""
    overview = Overview(jobs, folder)
    with run_lock(folder):
        overview.update()
        if retry_failed:
            for name in overview.of(State.FAILED):
                set_status(overview.jobs[name].folder, State.KILLED)
            overview.update()
        ended = overview.of(*ENDED)
        print(f"{folder}: {overview.counts()}", file=sys.stderr)
        with shown(overview, progress) as look:
            runner([job for name, job in overview.jobs.items() if name not in ended], look)
    overview.update()
    return overview
