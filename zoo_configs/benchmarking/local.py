"""A benchmark in processes of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait

from zoo_configs.benchmarking.child import Ending, RunProcess, Task
from zoo_configs.errors import CommandError

POLL = 0.5  # seconds between two looks
GRACE = 60.0  # seconds in which interrupted runs may save what they have


def run_here(tasks: Sequence[Task], jobs: int, look: Callable[[], None]) -> None:
    """
    Train runs, several at once. Those that fail do not stop the others; their folders say why.

    :param tasks: The runs, in the order in which they are begun
    :param jobs: How many at once
    :param look: Called now and then
    :raises CommandError: if the storage is full; the runs are stopped and can go on
    :raises KeyboardInterrupt: after Ctrl-C, when the runs have stopped; a second one kills them
    """
    waiting, running = list(reversed(tasks)), list[RunProcess]()
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running.append(RunProcess(waiting.pop()))
            wait([process.sentinel for process in running], POLL)
            ended = [process for process in running if process.wait(0)]
            running = [process for process in running if process not in ended]
            for process in ended:
                check_storage(process.ending(), process.task)
            look()
    finally:
        stop(running)


def check_storage(ending: Ending, task: Task) -> None:
    """
    Give up where no run can go on.

    :param ending: How a run ended
    :param task: The run
    :raises CommandError: if for want of storage
    """
    if ending is Ending.STORAGE:
        raise CommandError(f"{task.folder} is full or cannot be written any more: make room and start again")


def stop(running: Sequence[RunProcess]) -> None:
    """
    Interrupt runs and wait until they have saved what they have.

    :param running: Their processes
    """
    last = time.monotonic() + GRACE
    try:
        for process in running:
            process.interrupt()
        for process in running:
            process.wait(max(0.0, last - time.monotonic()))
    finally:
        for process in running:
            process.kill()
