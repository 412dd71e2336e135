"""CSV files of measurements: one row per measured item, with machine, date, commit and command."""

import csv
import datetime
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zoo_configs.drawing.tables import print_table
from zoo_configs.files import whole_file
from zoo_configs.provenance import commit, describe_hardware

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "docs" / "data"
PROVENANCE = ("machine", "date", "commit", "command")
"""Last columns of every file."""
Row = dict[str, str]
OTHER_EXPERIMENTS = ("--benchmark", "expert_episodes")
"""Options of runs that do not count for the success of their task."""


@dataclass(frozen=True)
class DataFile:
    """CSV file of measurements.

    :param path: its location; the file need not exist
    :param key: columns that identify a row
    """

    path: Path
    key: tuple[str, ...]

    def read(self) -> list[Row]:
        """Return all rows, an empty list if the file does not exist."""
        if not self.path.exists():
            return []
        with self.path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file, strict=True))
        if any(not {*self.key, *PROVENANCE} <= set(row) or None in row.values() for row in rows):
            sys.exit(f"{self.path} must have the columns {', '.join((*self.key, '...', *PROVENANCE))}")
        return rows

    def add(self, row: Row) -> None:
        """Append a row, or replace the row with the same key. The file is written atomically."""
        rows = {self._identity(known): known for known in self.read()}
        rows[self._identity(row)] = row
        with whole_file(self.path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(row), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows.values())

    def _identity(self, row: Row) -> tuple[str, ...]:
        return tuple(row[column] for column in self.key)


def runs_of_tasks(results: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the runs of each task with the preset ``cpu`` and without the options of other experiments."""
    runs: dict[str, list[Row]] = {}
    for row in results:
        if row["preset"] == "cpu" and not any(name in row["options"] for name in OTHER_EXPERIMENTS):
            runs.setdefault(row["env"], []).append(row)
    return runs


def keep(row: Row, path: Path | None, key: tuple[str, ...]) -> Row:
    """Add a row to a file, if one is given, and return the row."""
    if path is not None:
        DataFile(path, key).add(row)
    return row


def provenance(device: str = "cpu") -> Row:
    """Return machine, date, commit and command line of a measurement made now.

    :param device: PyTorch device that was measured
    """
    command = shlex.join(["python", *sys.argv])
    values = (describe_hardware(device), datetime.date.today().isoformat(), commit(), command)
    return dict(zip(PROVENANCE, values, strict=True))


def number(value: float, digits: int) -> str:
    """Format a number with at most some digits after the point; return an empty string for NaN."""
    if math.isnan(value):
        return ""
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if digits else text


def words(env_kwargs: Mapping[str, Any]) -> str:
    """Format an environment's parameters for a column."""
    return " ".join(f"{name}:{value!r}" for name, value in sorted(env_kwargs.items()))


def show(rows: Sequence[Row]) -> None:
    """Print rows as a table without their provenance."""
    columns = [name for name in rows[0] if name not in PROVENANCE]
    print_table(columns, [[row[name] for name in columns] for row in rows])
