"""Tables of the success rates of the experts, for ``fill_tables.py``."""

import os
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym

from bulletarm_gym.benchmarks import BENCHMARKS
from measurements import DataFile, Row
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.environments import our_env_ids, register_environments
from zoo_configs.experiments.families import task_name

ID = "id `BulletArm/...-v0`"
OPEN_LOOP = "OpenLoop"
UNEVEN = ("OpenLoopRamp", "OpenLoopBump")
MANY_EPISODES = 100
"""Number of episodes above which success rates have three digits."""
MOST_NAMED = 3
Belongs = Callable[[str], bool]


@dataclass(frozen=True)
class Source:
    """The folder of data files and the page that is filled from them."""

    folder: Path
    page: Path

    def read(self, name: str) -> list[Row]:
        """Return the rows of a file."""
        path = self.folder / f"{name}.csv"
        if not path.is_file():
            sys.exit(f"{path} must exist: {self.page} uses it")
        return DataFile(path, ()).read()

    def link(self, name: str) -> str:
        """Return a Markdown link to a file."""
        path = os.path.relpath(self.folder / f"{name}.csv", self.page.parent)
        return f"[{name}.csv]({Path(path).as_posix()})"

    def table(self, name: str, heads: Sequence[str], lines: Sequence[Sequence[str]], rows: list[Row]) -> str:
        """Return a table with the provenance of its rows below."""
        return f"{markdown_table(heads, lines)}\n\n{origins(rows)} ({self.link(name)})."


def origins(rows: Iterable[Row]) -> str:
    """Return machine, date and commit of rows, each combination once."""
    return "; ".join(
        dict.fromkeys(f"{row['machine']}, {row['date']}, commit {row['commit']}" for row in rows)
    )


COLUMNS = {
    "KUKA": ("kuka", ""),
    "KUKA, fixed orientation": ("kuka", "random_orientation:False"),
    "Panda": ("panda", ""),
    "UR5, jaw": ("ur5", ""),
    "UR5, 2F-85": ("ur5_robotiq", ""),
}
"""Arm and parameters of each column of the table of experts."""


def _is_in(column: str, row: Row) -> bool:
    """Return True if a row of the file belongs to a column."""
    robot, parameters = COLUMNS[column]
    fits = parameters in row["env_kwargs"] if parameters else not row["env_kwargs"]
    return row["robot"] == robot and fits and not row["snap"]


def expert_table(source: Source, belongs: Belongs) -> str:
    """Return the success rates of the experts of some tasks, one column an arm."""
    rows = [row for row in source.read("experts") if belongs(row["env"])]
    columns = {column: {row["env"]: row for row in rows if _is_in(column, row)} for column in COLUMNS}
    columns = {column: found for column, found in columns.items() if found}
    names = [name for name in task_names() if belongs(name)]
    lines = [[f"`{name}`", *(_expert(found.get(name)) for found in columns.values())] for name in names]
    table = markdown_table([ID, *columns], lines)
    notes = [f"- {column}: {_origins(list(found.values()))}" for column, found in columns.items()]
    legend = f"Success rate and mean number of steps of the solved episodes, from {source.link('experts')}:"
    return "\n\n".join([table, legend, "\n".join(notes)])


def other_experts(source: Source) -> str:
    """Return the success rates of the experts with parameters that have no column in the other tables."""
    rows = [row for row in source.read("experts") if not row["snap"]]
    rows = [row for row in rows if not any(_is_in(column, row) for column in COLUMNS)]
    lines = [
        [f"`{row['env']}`", row["robot"], f"`{row['env_kwargs']}`", _expert(row), _origin(row)]
        for row in rows
    ]
    heads = [ID, "arm", "parameters", "success, steps", f"from {source.link('experts')}"]
    return markdown_table(heads, lines, "---")


def grid_table(source: Source) -> str:
    """Return the success rates of the experts on the grid of spatial Q-learning."""
    rows = [row for row in source.read("experts") if row["snap"]]
    columns = {
        row["env_kwargs"]: [one for one in rows if one["env_kwargs"] == row["env_kwargs"]] for row in rows
    }
    found = {(row["env"], row["env_kwargs"]): _success(row) for row in rows}
    names = [name for name in task_names() if any(name == row["env"] for row in rows)]
    lines = [[f"`{name}`", *(found.get((name, kwargs), "") for kwargs in columns)] for name in names]
    table = markdown_table(["task", *(f"`{kwargs}`" for kwargs in columns)], lines)
    notes = [f"- `{kwargs}`: {_origins(of_kwargs)}" for kwargs, of_kwargs in columns.items()]
    return "\n\n".join([table, f"Success rate; all of {source.link('experts')}:", "\n".join(notes)])


def is_level(name: str) -> bool:
    """Return True for an open-loop task on a level surface."""
    return name.startswith(OPEN_LOOP) and not name.startswith(UNEVEN)


def is_of_paper(name: str) -> bool:
    """Return True for a task of the paper."""
    return name in {
        task_name(row.env_id) for benchmark in BENCHMARKS.values() for row in benchmark.environments
    }


def task_names() -> list[str]:
    """Return the names of all tasks in the order of their registration."""
    register_environments()
    return [
        task_name(env_id)
        for env_id in our_env_ids()
        if str(gym.spec(env_id).entry_point).startswith("bulletarm_gym.")
    ]


def _expert(row: Row | None) -> str:
    if row is None:
        return ""
    return _success(row) + (f", {float(row['mean_steps']):.1f}" if row["mean_steps"] else "")


def _success(row: Row) -> str:
    return f"{float(row['success']):.{3 if int(row['episodes']) > MANY_EPISODES else 2}f}"


def _origin(row: Row) -> str:
    return f"{row['episodes']} episodes, commit {row['commit']}, {row['date']}"


def _origins(rows: Sequence[Row]) -> str:
    """Return the origins of rows, the most frequent first, the others with the tasks that they belong to."""
    names: defaultdict[str, list[str]] = defaultdict(list)
    for row in rows:
        names[_origin(row)].append(f"`{row['env']}`")
    (usual, _), *others = Counter({origin: len(found) for origin, found in names.items()}).most_common()
    listed = {
        origin: ", ".join(names[origin]) if count <= MOST_NAMED else f"{count} tasks"
        for origin, count in others
    }
    return "; ".join([usual, *(f"{origin} ({tasks})" for origin, tasks in listed.items())])
