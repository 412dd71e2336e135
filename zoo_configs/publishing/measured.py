"""A table of what trainings reached, as data, and as Markdown in the pages that show it."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from fnmatch import fnmatchcase
from pathlib import Path

from zoo_configs.cells.rules import task_name
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.errors import CommandError, refused
from zoo_configs.files import whole_file

KEY = ("env", "options", "baseline", "preset", "seed")
HEADS = (
    "task",
    "baseline",
    "demonstrations, updates on them, steps",
    "best",
    "last",
    "second half: least, greatest",
    "minutes",
    "commit, date",
)
# <!-- results: quick CloseLoop* --> and <!-- end of results -->, which a table stands between.
PLACE = re.compile(
    r"(?P<head><!-- results: (?P<preset>\S+) (?P<tasks>\S+) -->\n).*?(?P<tail><!-- end of results -->)",
    re.DOTALL,
)


@dataclass(frozen=True)
class Row:
    """
    What a run reached, as in the file: all text, empty where not known.

    :param env: Id of the environment
    :param options: What was trained otherwise than the preset says, as behind ``-params``
    :param baseline: The baseline
    :param preset: The preset
    :param seed: Of the training
    :param demonstrations: How many
    :param noise: In the demonstrations
    :param dagger: ``yes`` if the expert was asked in the agent's own states
    :param updates: On the demonstrations, before the first step
    :param steps: Time steps of the training
    :param best: Success of the best model
    :param last: Success of the last model
    :param episodes: Of each of these evaluations
    :param least: Success in the second half of the run's own evaluations, the least
    :param greatest: The greatest
    :param minutes: Of training
    :param machine: It was trained on
    :param commit: It was trained with
    :param date: Of the end of the training
    :param command: Trains it again
    :param earlier: ``yes`` for a version whose environments or algorithms were others
    """

    env: str
    options: str
    baseline: str
    preset: str
    seed: str
    demonstrations: str = ""
    noise: str = ""
    dagger: str = ""
    updates: str = ""
    steps: str = ""
    best: str = ""
    last: str = ""
    episodes: str = ""
    least: str = ""
    greatest: str = ""
    minutes: str = ""
    machine: str = ""
    commit: str = ""
    date: str = ""
    command: str = ""
    earlier: str = ""

    @property
    def key(self) -> tuple[str, ...]:
        """What a row is replaced by: the same training, measured anew."""
        return tuple(getattr(self, name) for name in KEY)


COLUMNS = tuple(field.name for field in fields(Row))


def read_rows(path: Path) -> list[Row]:
    """
    Read a table.

    :param path: CSV; one that is not there has no rows
    :return: Its rows
    :raises CommandError: if it has other columns
    """
    if not path.is_file():
        return []
    with refused(f"{path} is no table of results"), path.open(encoding="utf-8", newline="") as file:
        return [Row(**row) for row in csv.DictReader(file)]


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """
    Write a table.

    :param path: CSV
    :param rows: Its rows
    """
    with whole_file(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def merge(rows: Sequence[Row], new: Row) -> list[Row]:
    """
    Put a row where the same training stood before, else at the end.

    :param rows: The rows so far
    :param new: The row
    :return: All rows
    """
    if new.key in [row.key for row in rows]:
        return [new if row.key == new.key else row for row in rows]
    return [*rows, new]


def render_page(text: str, rows: Sequence[Row]) -> str:
    """
    Put tables into a page, where comments such as ``<!-- results: quick CloseLoop* -->`` ask for them.

    :param text: The page
    :param rows: Of the table
    :return: The page with its tables
    :raises CommandError: if it has no place for a table
    """
    if not PLACE.search(text):
        raise CommandError("the page has no comment <!-- results: PRESET TASKS --> with its end")

    def table(place: re.Match[str]) -> str:
        shown = [row for row in rows if _belongs(row, place["preset"], place["tasks"])]
        body = markdown_table(HEADS, [_cells(row) for row in shown], text_columns=3)
        return f"{place['head']}\n{body}\n\n{place['tail']}"

    return PLACE.sub(table, text)


def _belongs(row: Row, preset: str, tasks: str) -> bool:
    return row.preset == preset and fnmatchcase(task_name(row.env), tasks)


def _cells(row: Row) -> list[str]:
    task = task_name(row.env).removeprefix("CloseLoop").removeprefix("OpenLoop")
    return [
        f"{task} (`{row.options}`)" if row.options else task,
        f"`{row.baseline}`",
        ", ".join([_demonstrations(row), _thousands(row.updates), _steps(row)]),
        _rate(row.best),
        _rate(row.last),
        f"{_rate(row.least)}, {_rate(row.greatest)}" if row.least else "",
        f"{float(row.minutes):.0f}" if row.minutes else "",
        ", ".join(part for part in (row.commit, row.date, "earlier" if row.earlier else "") if part),
    ]


def _demonstrations(row: Row) -> str:
    return _thousands(row.demonstrations) + (" with noise" if row.noise else "")


def _steps(row: Row) -> str:
    return _thousands(row.steps) + (" with DAgger" if row.dagger else "")


def _thousands(number: str) -> str:
    return f"{int(number):,}"


def _rate(number: str) -> str:
    return f"{float(number):.2f}" if number else ""
