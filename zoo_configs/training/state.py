"""Status of a run: which process trains it, and whether it is waiting, running, done, failed or killed."""

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import IO, NamedTuple

from zoo_configs.errors import CommandError, causes, reason, refused
from zoo_configs.files import read_yaml, write_yaml

STATE_FILE = "state.yml"
LOCK_FILE = ".lock"
TRIES, TRY_SECONDS = 10, 0.05
"""Attempts to lock a run, and seconds between two. Reading the status locks a run for a moment."""


class State(str, Enum):
    """State of a run."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    KILLED = "killed"


class RunStatus(NamedTuple):
    """
    Status of a run.

    :param host: Host name of the latest machine
    :param since: Start of the latest process, in seconds since 1970
    :param seconds: Training time of all processes together, without time steps that were trained again
    :param error: Reason for a failure
    :param until: End of that process, in seconds since 1970; 0 while it runs or if it was killed
    """

    state: State = State.WAITING
    host: str = ""
    pid: int = 0
    since: float = 0.0
    seconds: float = 0.0
    error: str = ""
    until: float = 0.0


def run_status(folder: Path) -> RunStatus:
    """Return the status of a run; raise ``CommandError`` if its file is damaged."""
    found = _read(folder)
    is_killed = found.state is State.RUNNING and not is_training(folder)  # it could not record its end
    return found._replace(state=State.KILLED) if is_killed else found


def _read(folder: Path) -> RunStatus:
    path = folder / STATE_FILE
    if not path.is_file():
        return RunStatus()
    content = read_yaml(path)
    with refused(f"{path} cannot be read"):
        return RunStatus(**{**content, "state": State(content["state"])})


def is_training(folder: Path) -> bool:
    """Return True if a process is training a run, on shared storage on any machine."""
    return is_locked(folder / LOCK_FILE)


def is_locked(path: Path) -> bool:
    """Return True if a process has locked a file."""
    if not path.is_file():
        return False
    with path.open() as file:  # also in a folder that is read-only
        return not lock(file, fcntl.LOCK_SH)


def lock(file: IO[str], kind: int = fcntl.LOCK_EX) -> bool:
    """Lock a file until it is closed or the process ends; return False if another process has locked it."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def set_status(folder: Path, state: State, error: str = "") -> None:
    """Set the status of a run whose process could not do so, unless the run is running or done."""
    if is_training(folder):
        return
    found = _read(folder)
    if found.state is not State.DONE:
        _write(folder, found._replace(state=state, error=error))


@contextmanager
def run_lock(folder: Path, checkpoint: Path | None = None) -> Iterator[None]:
    """
    Lock a run while it is trained, and keep its status up to date. A run that Ctrl-C ends counts as killed.

    :param checkpoint: The checkpoint to resume from, None at the start
    :raises CommandError: if another process is training the run
    """
    with (folder / LOCK_FILE).open("a") as file:
        tries = iter(range(TRIES))
        while not lock(file):
            if next(tries, None) is None:
                raise CommandError(f"{folder} is being trained by another process")
            time.sleep(TRY_SECONDS)
        spent = _spent(_read(folder), checkpoint)
        begun = RunStatus(State.RUNNING, socket.gethostname(), os.getpid(), time.time(), spent)
        _write(folder, begun)
        try:
            yield
        except BaseException as error:
            # PyTorch reports Ctrl-C while it writes a file as another error.
            is_interrupt = any(isinstance(cause, KeyboardInterrupt) for cause in causes(error))
            state = State.KILLED if is_interrupt else State.FAILED
            with contextlib.suppress(OSError):  # a full disk can be the reason
                _write(folder, _ended(begun, state, reason(error)))
            raise
        _write(folder, _ended(begun, State.DONE))


def _spent(before: RunStatus, checkpoint: Path | None) -> float:
    """Return the earlier training time up to the checkpoint, after which all is trained again."""
    if checkpoint is None or not before.since:
        return 0.0
    earlier, end = before.seconds, checkpoint.stat().st_mtime
    if before.until:  # its seconds contain those of the latest process
        earlier, end = earlier - (before.until - before.since), min(end, before.until)
    return earlier + max(0.0, end - before.since)


def _ended(begun: RunStatus, state: State, error: str = "") -> RunStatus:
    now = time.time()
    return begun._replace(state=state, seconds=begun.seconds + now - begun.since, error=error, until=now)


def _write(folder: Path, how: RunStatus) -> None:
    write_yaml(folder / STATE_FILE, {**how._asdict(), "state": how.state.value})
