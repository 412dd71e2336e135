"""Tables of what trainings reached."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from statistics import fmean

from zoo_configs.drawing.tables import markdown_table
from zoo_configs.measuring.data_files import RESULTS, Record
from zoo_configs.pages.markers import Source

HEADS = (
    "task",
    "baseline",
    "demonstrations, updates on them, steps",
    "seeds",
    "best",
    "last",
    "second half: least to greatest",
    "minutes",
    "commit, date",
)
TEXT_COLUMNS = 4
# What trainings have in common that differ in nothing but their seed.
TRAINING = ("env", "options", "baseline", "demonstrations", "noise", "dagger", "updates", "steps", "earlier")


def results_table(source: Source, preset: str, tasks: str) -> str:
    """
    Tell what runs reached, a row for those that differ in nothing but their seed, earlier ones last.

    :param source: The data
    :param preset: Of the runs
    :param tasks: Pattern of the environments' names
    :return: Markdown
    """
    trainings: dict[tuple[str, ...], list[Record]] = {}
    for run in source.read("results", RESULTS):
        if run["preset"] == preset and fnmatchcase(run["env"], tasks):
            trainings.setdefault(tuple(run[name] for name in TRAINING), []).append(run)
    in_order = sorted(trainings.values(), key=lambda runs: (runs[0]["earlier"], runs[0]["env"]))
    rows = [_cells(sorted(runs, key=lambda run: int(run["seed"]))) for runs in in_order]
    return markdown_table(HEADS, rows, text_columns=TEXT_COLUMNS)


def _cells(runs: Sequence[Record]) -> list[str]:
    first = runs[0]
    task = first["env"].removeprefix("CloseLoop").removeprefix("OpenLoop")
    demonstrations = _thousands(first["demonstrations"]) + (" with noise" if first["noise"] else "")
    steps = _thousands(first["steps"]) + (" with DAgger" if first["dagger"] else "")
    minutes = [float(run["minutes"]) for run in runs if run["minutes"]]
    return [
        f"{task} (`{first['options']}`)" if first["options"] else task,
        f"`{first['baseline']}`",
        ", ".join([demonstrations, _thousands(first["updates"]), steps]),
        ", ".join(run["seed"] for run in runs),
        _mean([run["best"] for run in runs]),
        _mean([run["last"] for run in runs]),
        "; ".join(f"{_rate(run['least'])} to {_rate(run['greatest'])}" for run in runs if run["least"]),
        f"{fmean(minutes):.0f}" if minutes else "",
        "; ".join(dict.fromkeys(map(_origin, runs))),
    ]


def _mean(rates: Sequence[str]) -> str:
    """The mean, and what it is of where it is of several."""
    known = [rate for rate in rates if rate]
    if len(known) < 2:
        return "".join(map(_rate, known))
    return f"{fmean(map(float, known)):.2f} ({', '.join(map(_rate, known))})"


def _origin(run: Record) -> str:
    parts = run["commit"], run["date"], "earlier" if run["earlier"] else ""
    return ", ".join(part for part in parts if part)


def _thousands(number: str) -> str:
    return f"{int(number):,}"


def _rate(number: str) -> str:
    return f"{float(number):.2f}"
