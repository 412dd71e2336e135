"""Status of the runs of a benchmark, read from their folders."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from zoo_configs.arguments import hides_progress
from zoo_configs.benchmarking.plan import Job
from zoo_configs.errors import CommandError
from zoo_configs.training.runs import EVALUATIONS_FILE
from zoo_configs.training.state import State, run_status

INTERVAL = 2.0  # seconds between two readings of the folders


class Status(Enum):
    """Status of a run. A killed run waits to be resumed."""

    DONE = "done"
    RUNNING = "running"
    WAITING = "waiting"
    FAILED = "failed"


class Entry(NamedTuple):
    """
    Status of one run.

    :param name: Its folder within that of the benchmark
    :param status: Its status
    :param timesteps: Time steps at its last evaluation, None before the first
    :param success: Success in its last evaluation
    :param host: Machine that trains it, or did
    :param error: Error of a failed run
    """

    name: str
    status: Status
    timesteps: int | None = None
    success: float | None = None
    host: str = ""
    error: str = ""

    def __str__(self) -> str:
        parts = [f"{self.status.value} {self.name}"]
        if self.success is not None:
            parts.append(f"success {self.success:.2f} at {self.timesteps}")
        if self.status is Status.RUNNING:
            parts.append(f"on {self.host}")
        return ", ".join(parts) + (f": {self.error}" if self.error else "")


class Overview:
    """
    Status of all runs.

    :param jobs: The runs
    :param folder: Folder of the benchmark
    """

    def __init__(self, jobs: Sequence[Job], folder: Path) -> None:
        self.folder = folder
        self.entries = {job.name: Entry(job.name, Status.WAITING) for job in jobs}

    def update(self) -> list[Entry]:
        """Read the folders of all runs that were not done, and return the entries that have changed."""
        before = dict(self.entries)
        for name, entry in before.items():
            if entry.status is not Status.DONE:
                self.entries[name] = read_entry(self.folder, name)
        return [entry for name, entry in self.entries.items() if entry != before[name]]

    def of(self, status: Status) -> list[Entry]:
        """Return the runs with a status."""
        return [entry for entry in self.entries.values() if entry.status is status]

    def counts(self) -> str:
        """Return the number of runs with each status."""
        counts = Counter(entry.status for entry in self.entries.values())
        return ", ".join(f"{counts[status]} {status.value}" for status in Status)


def read_entry(folder: Path, name: str) -> Entry:
    """Read the status of one run; ``name`` is its folder within that of the benchmark."""
    from zoo_configs.drawing.curves import load_curve

    try:
        found = run_status(folder / name)
    except CommandError as error:
        return Entry(name, Status.FAILED, error=str(error))
    if found is None:
        return Entry(name, Status.WAITING)
    status = Status.WAITING if found.state is State.KILLED else Status(found.state.value)
    message = found.error if status is Status.FAILED else ""
    try:
        curve = load_curve(folder / name / EVALUATIONS_FILE)
    except (CommandError, OSError):  # missing, or not yet visible in a shared folder
        return Entry(name, status, host=found.host, error=message)
    return Entry(name, status, int(curve.timesteps[-1]), float(curve.success[-1]), found.host, message)


@contextmanager
def shown(overview: Overview, progress: bool | None = None) -> Iterator[Callable[[], None]]:
    """
    Print each change of an overview, above a progress bar with the counts.

    :param overview: The overview
    :param progress: Whether to show the bar; None shows it on a terminal
    :return: Context manager of a function to call often, which updates the overview
    """
    last = -INTERVAL
    with tqdm(total=len(overview.entries), unit="run", disable=hides_progress(progress)) as bar:

        def update() -> None:
            nonlocal last
            if time.monotonic() - last < INTERVAL:
                return
            last = time.monotonic()
            for entry in overview.update():
                bar.write(f"[{overview.counts()}] {entry}", file=sys.stderr)
            bar.n = len(overview.of(Status.DONE)) + len(overview.of(Status.FAILED))
            bar.set_postfix_str(overview.counts())

        yield update
