"""How the runs of a benchmark stand, read from their folders: the same whoever trains them, and where."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from zoo_configs.benchmarking.sweep import Member
from zoo_configs.errors import CommandError
from zoo_configs.training.runs import EVALUATIONS_FILE
from zoo_configs.training.state import Standing, State, standing

if TYPE_CHECKING:
    from rich.table import Table

BENCHMARK_FILE = "benchmark.yml"  # what the folder is of
LOOK = 2.0  # seconds from one look into the folders to the next
MOST_ROWS = 30  # of an overview on a terminal


class Status(Enum):
    """What becomes of a run."""

    DONE = "done"
    RUNNING = "running"
    WAITING = "waiting"
    FAILED = "failed"


class Entry(NamedTuple):
    """
    How a run stands.

    :param name: Its folder within the benchmark's
    :param status: What becomes of it
    :param timesteps: At its last evaluation, None before the first
    :param success: Mean of its last evaluation
    :param host: The machine that trains it, or did
    :param error: Why it failed
    """

    name: str
    status: Status
    timesteps: int | None = None
    success: float | None = None
    host: str = ""
    error: str = ""

    def __str__(self) -> str:
        words = [self.status.value, self.name]
        if self.success is not None:
            words.append(f"success {self.success:.2f} at {self.timesteps}")
        if self.status is Status.RUNNING:
            words.append(f"on {self.host}")
        return ", ".join([" ".join(words[:2]), *words[2:]]) + (f": {self.error}" if self.error else "")


class Overview:
    """
    Looks into the folders of runs.

    :param members: The runs
    :param folder: The benchmark's folder
    """

    def __init__(self, members: Sequence[Member], folder: Path) -> None:
        self.folder = folder
        self.entries = {member.name: Entry(member.name, Status.WAITING) for member in members}

    def look(self) -> list[Entry]:
        """
        Look now. What is done is not looked at again.

        :return: The entries that have changed
        """
        before = dict(self.entries)
        for name, entry in before.items():
            if entry.status is not Status.DONE:
                self.entries[name] = read_entry(self.folder, name)
        return [entry for name, entry in self.entries.items() if entry != before[name]]

    def of(self, status: Status) -> list[Entry]:
        """The runs of which this becomes."""
        return [entry for entry in self.entries.values() if entry.status is status]

    def counts(self) -> str:
        """How many of each, in one line."""
        counts = Counter(entry.status for entry in self.entries.values())
        return ", ".join(f"{counts[status]} {status.value}" for status in Status)


def read_entry(folder: Path, name: str) -> Entry:
    """
    Read how one run stands.

    :param folder: The benchmark's folder
    :param name: The run's folder in it
    :return: Its entry
    """
    try:
        how = standing(folder / name)
    except CommandError as error:
        return Entry(name, Status.FAILED, error=str(error))
    if how is None:
        return Entry(name, Status.WAITING)
    timesteps, success = _last_evaluation(folder / name / EVALUATIONS_FILE)
    return Entry(
        name, _status(how), timesteps, success, how.host, how.error if how.state is State.FAILED else ""
    )


def _status(how: Standing) -> Status:
    """What was killed waits to go on."""
    return Status.WAITING if how.state is State.KILLED else Status(how.state.value)


def _last_evaluation(path: Path) -> tuple[int | None, float | None]:
    from zoo_configs.drawing.curves import load_curve

    if not path.is_file():
        return None, None
    try:
        curve = load_curve(path)
    except CommandError:  # it is whole; but a shared folder may show it late
        return None, None
    return int(curve.timesteps[-1]), float(curve.success[-1])


@contextmanager
def shown(overview: Overview, live: bool) -> Iterator[Callable[[], None]]:
    """
    Show an overview while runs are trained: on a terminal as a table that changes, else a line a change.

    :param overview: The overview
    :param live: Whether there is a terminal
    :return: Context manager of what is to be called now and then, and looks when it is time
    """
    if live:
        with _table(overview) as look:
            yield look
    else:
        yield _now_and_then(lambda: _print_changes(overview))


def _now_and_then(look: Callable[[], None]) -> Callable[[], None]:
    last = -LOOK

    def maybe() -> None:
        nonlocal last
        if time.monotonic() - last >= LOOK:
            last = time.monotonic()
            look()

    return maybe


def _print_changes(overview: Overview) -> None:
    for entry in overview.look():
        print(f"[{overview.counts()}] {entry}", file=sys.stderr, flush=True)


@contextmanager
def _table(overview: Overview) -> Iterator[Callable[[], None]]:
    from rich.console import Console, Group
    from rich.live import Live
    from rich.text import Text

    def render() -> Group:
        return Group(Text(overview.counts()), make_table(overview))

    with Live(render(), console=Console(stderr=True), auto_refresh=False, transient=True) as live:

        def look() -> None:
            overview.look()
            live.update(render(), refresh=True)

        yield _now_and_then(look)


def make_table(overview: Overview) -> Table:
    """
    What is running, and what has failed and why.

    :param overview: The overview
    :return: The table
    """
    from rich.table import Table

    table = Table("run", "steps", "success", "", box=None)
    told = [*overview.of(Status.RUNNING), *overview.of(Status.FAILED)]
    for entry in told[:MOST_ROWS]:
        success = "" if entry.success is None else f"{entry.success:.2f}"
        steps = "" if entry.timesteps is None else str(entry.timesteps)
        table.add_row(entry.name, steps, success, entry.error or f"on {entry.host}")
    if len(told) > MOST_ROWS:
        table.add_row(f"... and {len(told) - MOST_ROWS} more", "", "", "")
    return table
