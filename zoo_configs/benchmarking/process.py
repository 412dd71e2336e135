"""Runs in processes of this machine."""

import errno
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from zoo_configs.errors import CommandError, causes, reason
from zoo_configs.training.runs import Run
from zoo_configs.training.state import State, is_training, run_status, set_status
from zoo_configs.training.train import train_run

LOG_FILE = "log.txt"
LOCK_SECONDS, LOCK_POLL = 180.0, 0.2
"""Duration and interval of the wait for the lock of a lost process: NFS releases it after some 90 s."""
STORAGE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.ESTALE)
"""Errors that affect all runs."""
LEAST_FREE = 1 << 20  # bytes
PRELOADED = ["zoo_configs.training.train", "sb3_extensions.sacfd", "torch._dynamo"]
"""Modules that the fork server imports once for all processes; the last one is needed by optimizers."""
POLL = 0.5  # seconds
GRACE = 60.0  # seconds in which interrupted runs save their state


class ExitCode(IntEnum):
    """Exit code of a process."""

    DONE = 0
    FAILED = 3
    STORAGE = 74  # EX_IOERR of sysexits.h
    INTERRUPTED = 130  # 128 + SIGINT


class JobProcess:
    """Process group that trains one run, with its output in ``log.txt``, and is killed with its parent."""

    def __init__(self, job: Run, environ: Mapping[str, str] | None = None) -> None:
        # The fork server has imported PyTorch, but has neither threads nor a device.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(PRELOADED)
        self.run_folder, arguments = job.folder, (job, dict(environ or {}))
        self._process: BaseProcess = context.Process(target=_work, args=arguments, name=str(job.folder))
        self._process.start()
        self.sentinel = self._process.sentinel

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the end, at most ``timeout`` seconds, and return True if the process has ended."""
        self._process.join(timeout)
        return self._process.exitcode is not None

    def exit_code(self) -> ExitCode:
        """Return the exit code after the end; if a signal has ended the process, record it in the folder."""
        code = self._process.exitcode
        if code in tuple(ExitCode):
            return ExitCode(code)
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        set_status(self.run_folder, State.FAILED, f"its process was ended by {how}, see {LOG_FILE}")
        return ExitCode.FAILED

    def interrupt(self) -> None:
        """Interrupt the run as Ctrl-C does; it saves its state."""
        if self._process.is_alive() and self._process.pid is not None:
            os.kill(self._process.pid, signal.SIGINT)

    def kill(self) -> None:
        """Kill the process and its children."""
        if self._process.is_alive() and self._process.pid is not None:
            try:
                os.killpg(self._process.pid, signal.SIGKILL)
            except ProcessLookupError:  # it has no group yet
                self._process.kill()
        self._process.join()


def run_here(jobs: Sequence[Run], n_jobs: int, look: Callable[[], None]) -> None:
    """
    Train runs in processes of this machine, in the order of ``jobs``. A failed run does not stop the others.

    :param n_jobs: Number of runs at the same time
    :raises CommandError: if the storage is full; the runs are interrupted
    :raises KeyboardInterrupt: after Ctrl-C, when the runs have stopped; a second Ctrl-C kills them
    """
    waiting, running = list(reversed(jobs)), list[JobProcess]()
    try:
        while waiting or running:
            while waiting and len(running) < n_jobs:
                running.append(JobProcess(waiting.pop()))
            wait([process.sentinel for process in running], POLL)
            ended = [process for process in running if process.wait(0)]
            running = [process for process in running if process not in ended]
            for process in ended:
                check_storage(process.exit_code(), process.run_folder)
            look()
    finally:
        stop(running)


def check_storage(code: int, run_folder: Path) -> None:
    """Raise an error if a run has ended because its folder is full or not writable."""
    if code == ExitCode.STORAGE:
        raise CommandError(f"{run_folder} is full or not writable. Free space and start the command again")


def stop(running: Sequence[JobProcess]) -> None:
    """Interrupt runs, wait until they have saved their state, and kill the remaining ones."""
    last = time.monotonic() + GRACE
    try:
        for process in running:
            process.interrupt()
        for process in running:
            process.wait(max(0.0, last - time.monotonic()))
    finally:
        for process in running:
            process.kill()


def _work(job: Run, environ: Mapping[str, str]) -> None:
    """Run the process."""
    os.setsid()
    os.environ.update(environ)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _train(job)
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)
    except Exception as error:  # any error of the run
        traceback.print_exc()
        sys.exit(_record_failure(job.folder, error))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _train(job: Run) -> None:
    job.folder.mkdir(parents=True, exist_ok=True)
    with (job.folder / LOG_FILE).open("a", encoding="utf-8") as file:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(file.fileno(), stream.fileno())
    last = time.monotonic() + LOCK_SECONDS
    while is_training(job.folder) and time.monotonic() < last:
        time.sleep(LOCK_POLL)
    train_run(job)


def _record_failure(run_folder: Path, error: Exception) -> ExitCode:
    """Record an error in the run folder. A run without storage has not failed: it can be resumed."""
    is_full = any(isinstance(cause, OSError) and cause.errno in STORAGE_ERRORS for cause in causes(error))
    if is_full or shutil.disk_usage(run_folder).free < LEAST_FREE:
        if run_status(run_folder).state is State.FAILED:
            set_status(run_folder, State.KILLED)
        return ExitCode.STORAGE
    set_status(run_folder, State.FAILED, reason(error))
    return ExitCode.FAILED
