"""Tables of what trainings reached."""

from __future__ import annotations

from fnmatch import fnmatchcase

from zoo_configs.drawing.tables import markdown_table
from zoo_configs.measuring.data_files import RESULTS, Record
from zoo_configs.pages.markers import Source

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
TEXT_COLUMNS = 3


def results_table(source: Source, preset: str, tasks: str) -> str:
    """
    Tell what runs reached, a row for each.

    :param source: The data
    :param preset: Of the runs
    :param tasks: Pattern of the environments' names
    :return: Markdown
    """
    rows = [
        _cells(row)
        for row in source.read("results", RESULTS)
        if row["preset"] == preset and fnmatchcase(row["env"], tasks)
    ]
    return markdown_table(HEADS, rows, text_columns=TEXT_COLUMNS)


def _cells(row: Record) -> list[str]:
    task = row["env"].removeprefix("CloseLoop").removeprefix("OpenLoop")
    demonstrations = _thousands(row["demonstrations"]) + (" with noise" if row["noise"] else "")
    steps = _thousands(row["steps"]) + (" with DAgger" if row["dagger"] else "")
    return [
        f"{task} (`{row['options']}`)" if row["options"] else task,
        f"`{row['baseline']}`",
        ", ".join([demonstrations, _thousands(row["updates"]), steps]),
        _rate(row["best"]),
        _rate(row["last"]),
        f"{_rate(row['least'])}, {_rate(row['greatest'])}" if row["least"] else "",
        f"{float(row['minutes']):.0f}" if row["minutes"] else "",
        ", ".join(part for part in (row["commit"], row["date"], "earlier" if row["earlier"] else "") if part),
    ]


def _thousands(number: str) -> str:
    return f"{int(number):,}"


def _rate(number: str) -> str:
    return f"{float(number):.2f}" if number else ""
