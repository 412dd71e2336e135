"""Files of measurements: CSV with a row each, and where it comes from."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from zoo_configs.errors import CommandError, reason
from zoo_configs.files import check_writable, whole_file
from zoo_configs.measuring.provenance import PROVENANCE

Record = dict[str, str]


class Layout(NamedTuple):
    """
    What stands in a file of measurements.

    :param key: Columns by which a row is known: what was measured
    :param figures: Columns of what came of it
    """

    key: tuple[str, ...]
    figures: tuple[str, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns in their order."""
        return (*self.key, *self.figures, *PROVENANCE)


# Success is a share of the episodes, steps the mean length of the solved ones; the seeds follow the first.
EXPERTS = Layout(("env", "robot", "env_kwargs", "snap"), ("episodes", "first_seed", "success", "mean_steps"))
SPEED = Layout(
    ("env", "env_kwargs"),
    (
        *("yardstick_us", "steps_per_second", "step_ms", "physics_ms", "rendering_ms", "rest_ms"),
        *("without_expert_ms", "unsimulated", "reset_ms", "success", "episodes"),
        *("reference_steps_per_second", "times_reference", "load"),
    ),
)
# Parts of an update are shares of it; load is the mean of a minute before the measurement.
UPDATES = Layout(
    ("baseline", "preset", "env", "env_kwargs", "device"),
    (
        *("network", "threads", "update_ms", "peak_gigabytes", "gradients_of_convolutions", "convolutions"),
        *("pooling", "rest", "equivariant_over_plain", "load"),
    ),
)
# CPU seconds are medians; the overhead is a share of the bare training: median, least, greatest.
OVERHEAD = Layout(
    ("baseline", "preset", "env", "env_kwargs", "timesteps"),
    ("bare_seconds", "train_seconds", "overhead", "least", "greatest"),
)
# Attempts are those that the episodes took, the rate counts start-up.
COLLECTING = Layout(
    ("env", "env_kwargs", "planner"),
    ("episodes", "seed", "attempts", "mean_steps", "episodes_per_minute", "load"),
)
# Bodies are lines from the first statement behind the docstring to the last.
CODE = Layout(
    ("stand", "package"),
    ("files", "lines", "functions", "median_body", "p90_body", "longest_body", "longest_file"),
)


# Best and last are success of these models over the episodes, least and greatest of the run's own
# evaluations in its second half; options are what the preset does not say; earlier is yes for other
# environments, learners or presets: such a row stays when the same training is measured anew.
RESULTS = Layout(
    ("env", "options", "baseline", "preset", "seed", "earlier"),
    (
        *("demonstrations", "noise", "dagger", "updates", "steps", "best", "last", "episodes"),
        *("least", "greatest", "minutes"),
    ),
)
# What a figure of learning curves is drawn from, a row a run: evaluations are pairs step:success (return,
# where the measure is that), episodes those of one evaluation.
CURVES = Layout(("env", "baseline", "seed"), ("measure", "episodes", "evaluations", "state", "minutes"))


@dataclass(frozen=True)
class DataFile:
    """
    A file of measurements.

    :param path: Where it is, or is to be
    :param layout: What stands in it
    """

    path: Path
    layout: Layout

    def check(self, name: str) -> None:
        """
        Ask whether rows can be added, before the work that measures them begins.

        :param name: Which argument the path comes from
        :raises CommandError: if not, with the reason
        """
        check_writable(self.path, name)
        self.read(name)

    def read(self, name: str = "data") -> list[Record]:
        """
        Read all rows.

        :param name: Which argument the path comes from
        :return: From column to text, in the order of the file; nothing where there is no file
        :raises CommandError: if the file has other columns or cannot be read
        """
        if not self.path.exists():
            return []
        try:
            with self.path.open(encoding="utf-8", newline="") as file:
                reader = csv.DictReader(file, strict=True)
                rows = list(reader)
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise CommandError(f"{name}: {self.path} cannot be read: {reason(error)}") from error
        columns = tuple(reader.fieldnames or ())
        if columns != self.layout.columns or any(None in row or None in row.values() for row in rows):
            takes = ",".join(self.layout.columns)
            raise CommandError(
                f"{name}: {self.path} is no such file of measurements: its columns are {takes}"
            )
        return rows

    def add(self, row: Mapping[str, str]) -> None:
        """
        Add a row, or put it in the place of the one with the same key. The file is written whole.

        :param row: A value for each column
        """
        rows = {self._key(known): known for known in self.read()}
        rows[self._key(row)] = dict(row)
        with whole_file(self.path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, self.layout.columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows.values())

    def _key(self, row: Mapping[str, str]) -> tuple[str, ...]:
        return tuple(row[column] for column in self.layout.key)


def number(value: float, digits: int) -> str:
    """
    Write a figure for a file.

    :param value: The figure
    :param digits: Behind the point at most, those that say nothing are left out
    :return: Text; nothing for what is no number
    """
    if math.isnan(value):
        return ""
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if digits else text
