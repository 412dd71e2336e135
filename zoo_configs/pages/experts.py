"""Tables of how often experts succeed."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from zoo_configs.cells.rules import task_name
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.environments import our_env_ids, register_environments
from zoo_configs.measuring.data_files import EXPERTS, Record
from zoo_configs.pages.markers import Source

DATA = "experts"
ID = "id `BulletArm/...-v0`"
OPEN_LOOP = "OpenLoop"
UNEVEN = ("OpenLoopRamp", "OpenLoopBump")
MANY = 100  # episodes, of which a third digit says something
MOST_NAMED = 3


class Column(NamedTuple):
    """
    A column of the table.

    :param title: Its head
    :param robot: Name of the arm
    :param is_fixed: Whether objects start in one orientation and the gripper does not turn
    """

    title: str
    robot: str
    is_fixed: bool = False

    def has(self, row: Record) -> bool:
        """
        Whether a row belongs here.

        :param row: Of the file
        :return: Whether it does
        """
        kwargs = row["env_kwargs"]
        fits = "random_orientation:False" in kwargs if self.is_fixed else not kwargs
        return row["robot"] == self.robot and fits and not row["snap"]


COLUMNS = (
    Column("KUKA", "kuka"),
    Column("KUKA, fixed orientation", "kuka", is_fixed=True),
    Column("Panda", "panda"),
    Column("UR5, jaw", "ur5"),
    Column("UR5, 2F-85", "ur5_robotiq"),
)


def expert_table(source: Source, belongs: Callable[[str], bool]) -> str:
    """
    Put the experts of some tasks side by side, a column an arm.

    :param source: The data
    :param belongs: Which tasks, by their names
    :return: Markdown
    """
    rows = [row for row in source.read(DATA, EXPERTS) if belongs(row["env"])]
    columns = {column: {row["env"]: row for row in rows if column.has(row)} for column in COLUMNS}
    columns = {column: found for column, found in columns.items() if found}
    lines = [
        [f"`{name}`", *(_cell(found.get(name)) for found in columns.values())]
        for name in task_names()
        if belongs(name)
    ]
    table = markdown_table([ID, *(column.title for column in columns)], lines)
    told = [f"- {column.title}: {_origins(list(found.values()))}" for column, found in columns.items()]
    legend = f"Success rate, mean number of steps of the solved episodes; all of {source.link(DATA)}:"
    return "\n\n".join([table, legend, "\n".join(told)])


def elsewhere_table(source: Source) -> str:
    """
    Tell how experts do with parameters that have no column in the other tables.

    :param source: The data
    :return: Markdown
    """
    rows = [row for row in source.read(DATA, EXPERTS) if not row["snap"]]
    rows = [row for row in rows if not any(column.has(row) for column in COLUMNS)]
    lines = [
        [f"`{row['env']}`", row["robot"], f"`{row['env_kwargs']}`", _cell(row), _origin(row)] for row in rows
    ]
    heads = [ID, "arm", "parameters", "success, steps", f"of {source.link(DATA)}"]
    return markdown_table(heads, lines, "---")


def grid_table(source: Source) -> str:
    """
    Tell how experts do whose actions are carried out on the grid of spatial Q-learning.

    :param source: The data
    :return: Markdown
    """
    rows = [row for row in source.read(DATA, EXPERTS) if row["snap"]]
    found = {(row["env"], row["env_kwargs"]): row for row in rows}
    names, columns = (
        dict.fromkeys(row["env"] for row in rows),
        dict.fromkeys(row["env_kwargs"] for row in rows),
    )
    lines = [
        [
            f"`{name}`",
            *(_success(found[name, kwargs]) if (name, kwargs) in found else "" for kwargs in columns),
        ]
        for name in task_names()
        if name in names
    ]
    table = markdown_table(["task", *(f"`{kwargs}`" for kwargs in columns)], lines)
    told = [
        f"- `{kwargs}`: {_origins([row for row in rows if row['env_kwargs'] == kwargs])}"
        for kwargs in columns
    ]
    return "\n\n".join([table, f"Success rate; all of {source.link(DATA)}:", "\n".join(told)])


def is_open_loop(name: str) -> bool:
    """Open-loop tasks on level ground."""
    return name.startswith(OPEN_LOOP) and not is_uneven(name)


def is_uneven(name: str) -> bool:
    """Open-loop tasks on ramps and bumps."""
    return name.startswith(UNEVEN)


def is_papers_close_loop(name: str) -> bool:
    """Close-loop tasks of the paper."""
    return not name.startswith(OPEN_LOOP) and name in _paper()


def is_composed(name: str) -> bool:
    """Close-loop tasks that are not in the paper."""
    return not name.startswith(OPEN_LOOP) and name not in _paper()


def task_names() -> list[str]:
    """
    Name all tasks.

    :return: Names in the order of their registration
    """
    register_environments()
    return [task_name(env_id) for env_id in our_env_ids()]


def _paper() -> set[str]:
    from bulletarm_gym.benchmarks import BENCHMARKS

    return {task_name(row.env_id) for benchmark in BENCHMARKS.values() for row in benchmark.environments}


def _cell(row: Record | None) -> str:
    if row is None:
        return ""
    steps = f", {float(row['mean_steps']):.1f}" if row["mean_steps"] else ""
    return _success(row) + steps


def _success(row: Record) -> str:
    digits = 3 if int(row["episodes"]) > MANY else 2
    return f"{float(row['success']):.{digits}f}"


def _origins(rows: Sequence[Record]) -> str:
    """Episodes, commit and date of rows, the most frequent first; of the others which they are."""
    counts: Counter[str] = Counter()
    names: defaultdict[str, list[str]] = defaultdict(list)
    for row in rows:
        counts[origin := _origin(row)] += 1
        names[origin].append(row["env"])
    usual, *others = [origin for origin, _ in counts.most_common()]
    return "; ".join([usual, *(f"{origin} ({_named(names[origin])})" for origin in others)])


def _origin(row: Record) -> str:
    return f"{row['episodes']} episodes, commit {row['commit']}, {row['date']}"


def _named(names: Iterable[str]) -> str:
    named = [f"`{name}`" for name in names]
    return ", ".join(named) if len(named) <= MOST_NAMED else f"{len(named)} tasks"
