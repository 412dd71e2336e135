"""Status of the runs of a benchmark, read from their folders."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from zoo_configs.arguments import hides_progress
from zoo_configs.benchmarking.plan import Job
from zoo_configs.errors import CommandError
from zoo_configs.training.runs import EVALUATIONS_FILE
from zoo_configs.training.state import State, run_status

INTERVAL = 2.0  # seconds between two readings of the folders
WAITING = "waiting"
STATES = (State.DONE.value, State.RUNNING.value, WAITING, State.FAILED.value)
"""States of a run of a benchmark. A killed run waits to be resumed."""


class Entry(NamedTuple):
    """State of one run, its latest success, and its machine or error."""

    name: str
    state: str = WAITING
    success: str = ""
    detail: str = ""

    def __str__(self) -> str:
        return ", ".join(filter(None, (f"{self.state} {self.name}", self.success, self.detail)))


class Overview:
    """
    States of all runs.

    :param jobs: The runs
    :param folder: Folder of the benchmark
    """

    def __init__(self, jobs: Sequence[Job], folder: Path) -> None:
        self.folder = folder
        self.entries = {job.name: Entry(job.name) for job in jobs}

    def update(self) -> list[Entry]:
        """Read the folders of all runs that were not done, and return the entries that have changed."""
        before = dict(self.entries)
        for name, entry in before.items():
            if entry.state != State.DONE.value:
                self.entries[name] = _read_entry(self.folder, name)
        return [entry for name, entry in self.entries.items() if entry != before[name]]

    def of(self, state: str) -> list[Entry]:
        """Return the runs with a state."""
        return [entry for entry in self.entries.values() if entry.state == state]

    def counts(self) -> str:
        """Return the number of runs with each state."""
        counts = Counter(entry.state for entry in self.entries.values())
        return ", ".join(f"{counts[state]} {state}" for state in STATES)


def _read_entry(folder: Path, name: str) -> Entry:
    from zoo_configs.drawing.curves import load_curve

    try:
        found = run_status(folder / name)
    except CommandError as error:
        return Entry(name, State.FAILED.value, detail=str(error))
    if found is None:
        return Entry(name)
    state = WAITING if found.state is State.KILLED else found.state.value
    details = {State.RUNNING: f"on {found.host}", State.FAILED: found.error}
    try:
        curve = load_curve(folder / name / EVALUATIONS_FILE)
        success = f"success {curve.success[-1]:.2f} at {curve.timesteps[-1]}"
    except (CommandError, OSError):  # missing, or not yet visible in a shared folder
        success = ""
    return Entry(name, state, success, details.get(found.state, ""))


@contextmanager
def shown(overview: Overview, progress: bool | None = None) -> Iterator[Callable[[], None]]:
    """
    Print each change of an overview, above a progress bar with the counts.

    Provide a function to call often, which updates the overview. None shows the bar on a terminal.
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
            bar.n = len(overview.of(State.DONE.value)) + len(overview.of(State.FAILED.value))
            bar.set_postfix_str(overview.counts())

        yield update
