"""What becomes of a run: who trains it, and whether it is running, done, failed or killed."""

from __future__ import annotations

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

import yaml

from zoo_configs.errors import CommandError, reason
from zoo_configs.files import whole_file

STATE_FILE = "state.yml"
LOCK_FILE = ".lock"
# Who asks whether a run is held takes its lock for a moment: look several times, with seconds between.
LOOKS, LOOK = 10, 0.05


class NothingToDo(CommandError):
    """A run is done already: how it stands does not change."""


class State(str, Enum):
    """What a run is doing."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    KILLED = "killed"


class Standing(NamedTuple):
    """
    How a run stands.

    :param state: What it is doing
    :param host: The machine that trains it, or did
    :param pid: The process
    :param since: When that began, seconds since 1970
    :param seconds: How long it has been trained before, by all processes together
    :param error: Why it failed
    :param until: When that ended, seconds since 1970; 0 while it goes on, and where the process was killed
    """

    state: State
    host: str = ""
    pid: int = 0
    since: float = 0.0
    seconds: float = 0.0
    error: str = ""
    until: float = 0.0


def standing(folder: Path) -> Standing | None:
    """
    Read how a run stands. One that is called running, but that no process holds, was killed.

    :param folder: Run folder
    :return: How it stands, None if no training has begun
    :raises CommandError: if the folder says something else
    """
    found = _read(folder)
    if found is not None and found.state is State.RUNNING and not is_held(folder):
        return found._replace(state=State.KILLED)
    return found


def _read(folder: Path) -> Standing | None:
    """What a folder says of itself."""
    path = folder / STATE_FILE
    if not path.is_file():
        return None
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        return Standing(**{**content, "state": State(content["state"])})
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise CommandError(f"{path} cannot be read: {reason(error)}") from error


def is_held(folder: Path) -> bool:
    """
    Whether a process is training a run; on shared storage on any machine.

    :param folder: Run folder
    :return: Whether its lock is taken
    """
    return is_locked(folder / LOCK_FILE)


def is_locked(path: Path) -> bool:
    """
    Whether a process holds a lock.

    :param path: File of the lock
    :return: Whether it is taken
    """
    if not path.is_file():
        return False
    with path.open("a") as file:
        return not lock(file)


def lock(file: IO[str]) -> bool:
    """
    Take a lock that goes with the process, if it is free.

    :param file: Open file of the lock, which is free again when it is closed
    :return: Whether it is ours now
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def note(folder: Path, state: State, error: str = "") -> None:
    """
    Say from outside how a run stands, for one that could not say it itself. What a process is training, or
    is done, stays as it is.

    :param folder: Run folder, made if needed
    :param state: How it stands
    :param error: Why it failed
    """
    if is_held(folder):
        return
    found = _read(folder) or Standing(State.KILLED, socket.gethostname(), os.getpid(), time.time())
    if found.state is not State.DONE:
        _write(folder, found._replace(state=state, error=error))


@contextmanager
def held(folder: Path, checkpoint: Path | None = None) -> Iterator[bool]:
    """
    Train a run: nobody else may meanwhile, and the folder says how it stands, whatever happens. What ends by
    Ctrl-C counts as killed.

    :param folder: Run folder
    :param checkpoint: What it goes on from, None if it begins
    :return: Context manager: whether the run was done before
    :raises CommandError: if another process is training it
    """
    with (folder / LOCK_FILE).open("a") as file:
        if not _lock_soon(file):
            raise CommandError(f"{folder} is being trained by another process")
        before = _read(folder)
        begun = Standing(State.RUNNING, socket.gethostname(), os.getpid(), time.time())
        begun = begun._replace(seconds=_spent(before, checkpoint))
        _write(folder, begun)
        try:
            yield before is not None and before.state is State.DONE
        except NothingToDo:
            _write(folder, before or _ended(begun, State.DONE))
            raise
        except BaseException as error:
            state = State.KILLED if isinstance(error, KeyboardInterrupt) else State.FAILED
            with contextlib.suppress(OSError):  # a full disk may be the reason
                _write(folder, _ended(begun, state, reason(error)))
            raise
        _write(folder, _ended(begun, State.DONE))


def _spent(before: Standing | None, checkpoint: Path | None) -> float:
    """How long a run has been trained; who was killed could not say, and got as far as the checkpoint."""
    if before is None:
        return 0.0
    if before.until or before.state is State.DONE or checkpoint is None:
        return before.seconds
    return before.seconds + max(0.0, checkpoint.stat().st_mtime - before.since)


def _ended(begun: Standing, state: State, error: str = "") -> Standing:
    now = time.time()
    return begun._replace(state=state, seconds=begun.seconds + now - begun.since, error=error, until=now)


def _lock_soon(file: IO[str]) -> bool:
    for _ in range(LOOKS):
        if lock(file):
            return True
        time.sleep(LOOK)
    return False


def _write(folder: Path, how: Standing) -> None:
    content = {**how._asdict(), "state": how.state.value}
    with whole_file(folder / STATE_FILE) as partial, partial.open("w", encoding="utf-8") as file:
        yaml.safe_dump(content, file, sort_keys=False)
