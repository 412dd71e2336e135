"""One run in a process of its own, which ends with whoever began it."""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from multiprocessing.process import BaseProcess
from pathlib import Path

from zoo_configs.benchmarking.sweep import Member
from zoo_configs.errors import reason
from zoo_configs.training.state import State, is_held, note, standing

LOG_FILE = "log.txt"
# The run of a machine that was lost may be held until its file system notices: NFS gives a lease of 90 s.
PATIENCE, LOOK = 180.0, 0.2  # seconds
# Nothing of a run's own making: no run can be written, or none of this folder.
STORAGE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.ESTALE)
LEAST_FREE = 1 << 20  # bytes
# What the server that processes are forked from imports once.
PRELOADED = ("zoo_configs.training.cell", "zoo_configs.environments", "sb3_extensions.sacfd", "torch._dynamo")


class Ending(IntEnum):
    """How a process ended: its exit code."""

    DONE = 0
    FAILED = 3
    STORAGE = 74  # EX_IOERR of sysexits.h
    INTERRUPTED = 130  # 128 + SIGINT


@dataclass(frozen=True)
class Task:
    """
    What a process is to do.

    :param member: The run
    :param folder: The benchmark's folder
    :param gym_packages: Packages that register the environment, besides our own
    :param device: PyTorch device
    :param environ: Environment variables
    """

    member: Member
    folder: Path
    gym_packages: tuple[str, ...] = ()
    device: str = "auto"
    environ: Mapping[str, str] = field(default_factory=dict)

    @property
    def place(self) -> Path:
        """The run's folder."""
        return self.folder / self.member.name


class RunProcess:
    """
    A process that trains one run, in a process group of its own; what it prints goes to ``log.txt`` in the
    run's folder. It is killed when the process that began it ends, however that happens.

    :param task: What it is to do
    """

    def __init__(self, task: Task) -> None:
        # Forked from a server that has imported PyTorch, but has neither threads nor a device.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(list(PRELOADED))
        self.task = task
        self._process: BaseProcess = context.Process(target=_work, args=(task,), name=task.member.name)
        self._process.start()

    @property
    def sentinel(self) -> int:
        """What ``multiprocessing.connection.wait`` waits for."""
        return self._process.sentinel

    def wait(self, timeout: float | None = None) -> bool:
        """
        Wait for the end.

        :param timeout: Seconds
        :return: Whether it has come
        """
        self._process.join(timeout)
        return self._process.exitcode is not None

    def ending(self) -> Ending:
        """
        Take note of how the process ended, once it has.

        :return: How; one that a signal ended has failed, and its folder says so
        """
        code = self._process.exitcode
        if code in tuple(Ending):
            return Ending(code)
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        note(self.task.place, State.FAILED, f"its process was ended by {how}, see {LOG_FILE}")
        return Ending.FAILED

    def interrupt(self) -> None:
        """End the run as Ctrl-C does: what is whole is saved, and it can go on."""
        if self._process.is_alive() and self._process.pid is not None:
            os.kill(self._process.pid, signal.SIGINT)

    def kill(self) -> None:
        """End the process and all that it began, at once."""
        if self._process.is_alive() and self._process.pid is not None:
            try:
                os.killpg(self._process.pid, signal.SIGKILL)
            except ProcessLookupError:  # it has no group yet
                self._process.kill()
        self._process.join()


def _work(task: Task) -> None:
    """What the process does."""
    os.setsid()
    os.environ.update(task.environ)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_follow_parent, daemon=True).start()
    try:
        _train(task)
    except KeyboardInterrupt:
        sys.exit(Ending.INTERRUPTED)
    except Exception as error:  # whatever ends a run ends no other
        traceback.print_exc()
        sys.exit(_explain(task, error))


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _train(task: Task) -> None:
    from zoo_configs.training.cell import train_cell

    task.place.mkdir(parents=True, exist_ok=True)
    _write_to(task.place / LOG_FILE)
    _wait_until_free(task.place)
    member = task.member
    train_cell(
        member.cell,
        member.seed,
        task.device,
        task.folder,
        options=member.options,
        at=task.place,
        gym_packages=task.gym_packages,
    )


def _write_to(path: Path) -> None:
    with path.open("a", encoding="utf-8") as file:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(file.fileno(), stream.fileno())


def _wait_until_free(place: Path) -> None:
    """Whoever trained it before may be about to end."""
    last = time.monotonic() + PATIENCE
    while is_held(place) and time.monotonic() < last:
        time.sleep(LOOK)


def _explain(task: Task, error: Exception) -> Ending:
    """Say in the folder why the run failed; for want of storage it has not, it cannot go on."""
    if is_storage_error(error) or shutil.disk_usage(task.folder).free < LEAST_FREE:
        how = standing(task.place)
        if how is not None and how.state is State.FAILED:
            note(task.place, State.KILLED)
        return Ending.STORAGE
    note(task.place, State.FAILED, reason(error))
    return Ending.FAILED


def is_storage_error(error: BaseException | None) -> bool:
    """
    Whether an error, or one that led to it, is of the storage.

    :param error: The error
    :return: Whether the disk is full, or cannot be written
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in STORAGE_ERRORS:
            return True
        error = error.__cause__ or error.__context__
    return False
