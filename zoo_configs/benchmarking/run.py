"""From the runs of a benchmark to their folders, by whatever runner."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import yaml

from zoo_configs.benchmarking.child import Task
from zoo_configs.benchmarking.overview import BENCHMARK_FILE, Overview, Status, shown
from zoo_configs.benchmarking.sweep import Member, Sweep
from zoo_configs.cells.validation import check_cell
from zoo_configs.environments import try_env
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, whole_file
from zoo_configs.training.cell import check_same
from zoo_configs.training.runs import RESOLVED_FILE, Run, load_run
from zoo_configs.training.state import State, held, note

# Trains runs and looks around now and then; what becomes of each run stands in its folder.
Runner = Callable[[Sequence[Task], Callable[[], None]], None]


def check_cells(sweep: Sweep) -> None:
    """
    Check the names and values of each cell, and try each environment once.

    :param sweep: The benchmark
    :raises CommandError: for what cannot be trained
    """
    tried = set()
    for cell in sweep.cells:
        check_cell(cell)
        env_kwargs = cell.hyperparams.get("env_kwargs", {})
        key = (cell.env_id, json.dumps(env_kwargs, sort_keys=True, default=str))
        if key not in tried:
            try_env(cell.env_id, env_kwargs)
            tried.add(key)


def check_folder(sweep: Sweep, folder: Path) -> None:
    """
    Look whether runs can be put into a folder, and whether those that are there belong to this benchmark.

    :param sweep: The benchmark
    :param folder: Its folder
    :raises CommandError: if not
    """
    if folder.exists() and not folder.is_dir():
        raise CommandError(f"--log-folder: {folder} is a file, it takes a folder")
    check_writable(folder / BENCHMARK_FILE, "--log-folder")
    for member in sweep.members:
        place = folder / member.name
        if (place / RESOLVED_FILE).is_file():
            check_same(load_run(place), Run(place, member.cell, member.seed))


def run_sweep(
    sweep: Sweep,
    folder: Path,
    runner: Runner,
    command: str = "",
    retry_failed: bool = False,
    live: bool = False,
) -> Overview:
    """
    Train the runs that are not done; nobody else may work on the benchmark meanwhile.

    :param sweep: The benchmark
    :param folder: Its folder; it is there
    :param runner: What trains
    :param command: The command line, for the page of the results
    :param retry_failed: Whether runs that have failed are begun again
    :param live: Whether to show the overview as a table that changes, for a terminal
    :return: How the runs stand
    :raises CommandError: if the runner cannot go on; the runs can
    """
    overview = Overview(sweep.members, folder)
    with held(folder):
        _write_about(sweep, folder, command)
        waiting = _waiting(sweep, overview, retry_failed)
        print(f"{folder}: {overview.counts()}", file=sys.stderr)
        tasks = [Task(member, folder.absolute(), sweep.gym_packages, sweep.device) for member in waiting]
        with shown(overview, live) as look:
            runner(tasks, look)
    overview.look()
    return overview


def _write_about(sweep: Sweep, folder: Path, command: str) -> None:
    """What the page of the results begins with."""
    about = {"name": sweep.name, "command": command, "runs": [member.name for member in sweep.members]}
    with whole_file(folder / BENCHMARK_FILE) as partial, partial.open("w", encoding="utf-8") as file:
        yaml.safe_dump(about, file, sort_keys=False)


def _waiting(sweep: Sweep, overview: Overview, retry_failed: bool) -> list[Member]:
    """The runs that are to be trained; those that have failed only if that is wanted."""
    overview.look()
    if retry_failed:
        for entry in overview.of(Status.FAILED):
            note(overview.folder / entry.name, State.KILLED)
        overview.look()
    ended = (Status.DONE, Status.FAILED)
    return [member for member in sweep.members if overview.entries[member.name].status not in ended]
