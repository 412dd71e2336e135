"""The tables of results as text and as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from zoo_configs.cells.rules import task_name
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.files import whole_file

CELL_HEADS = (
    "task",
    "baseline",
    "success",
    "± over seeds",
    "95 % interval",
    "seeds",
    "done",
    "steps",
    "minutes",
)
BASELINE_HEADS = ("baseline", "interquartile mean", "95 % interval", "mean", "tasks", "runs")
EXPLANATION = """Success: mean of the last evaluations of all seeds, ± its standard error over seeds;
interval: Wilson's, over all their episodes, which does not see how seeds differ. Minutes: mean of a run.
Over all tasks: interquartile mean of the runs with the percentile bootstrap's interval, seeds drawn anew
within each task (with one seed a task, runs from all tasks)."""


def cell_rows(cells: pd.DataFrame) -> list[list[str]]:
    """
    The table of cells as text.

    :param cells: From :func:`zoo_configs.benchmarking.results.cell_table`
    :return: Its rows, under ``CELL_HEADS``
    """
    return [
        [
            task_name(row["task"]),
            row["baseline"],
            _number(row["success"]),
            _number(row["error"]),
            _interval(row["low"], row["high"]),
            row["seeds"],
            f"{row['done']} of {len(row['seeds'].split())}",
            str(row["timesteps"]),
            _number(row["minutes"], digits=1),
        ]
        for row in cells.to_dict("records")
    ]


def baseline_rows(baselines: pd.DataFrame) -> list[list[str]]:
    """
    The table of baselines as text.

    :param baselines: From :func:`zoo_configs.benchmarking.results.baseline_table`
    :return: Its rows, under ``BASELINE_HEADS``
    """
    return [
        [
            row["baseline"],
            _number(row["iqm"]),
            _interval(row["low"], row["high"]),
            _number(row["mean"]),
            str(row["tasks"]),
            str(row["runs"]),
        ]
        for row in baselines.to_dict("records")
    ]


def _number(value: float, digits: int = 2) -> str:
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def _interval(low: float, high: float) -> str:
    return "" if np.isnan(low) else f"{low:.2f} to {high:.2f}"


def markdown(cells: pd.DataFrame, baselines: pd.DataFrame) -> str:
    """
    Both tables and the commands that repeat the cells.

    :param cells: From :func:`zoo_configs.benchmarking.results.cell_table`
    :param baselines: From :func:`zoo_configs.benchmarking.results.baseline_table`
    :return: Markdown
    """
    parts = [
        markdown_table(CELL_HEADS, cell_rows(cells)),
        markdown_table(BASELINE_HEADS, baseline_rows(baselines)),
        EXPLANATION,
        "Each cell again, with its first seed:",
        "\n".join(f"    {command}" for command in cells["command"]),
    ]
    return "\n\n".join(parts) + "\n"


def write_tables(cells: pd.DataFrame, baselines: pd.DataFrame, picture: Path) -> list[Path]:
    """
    Write the tables beside a picture.

    :param cells: From :func:`zoo_configs.benchmarking.results.cell_table`
    :param baselines: From :func:`zoo_configs.benchmarking.results.baseline_table`
    :param picture: The picture, whose name they get
    :return: A Markdown file with both, a CSV with the cells
    """
    page, table = picture.with_suffix(".md"), picture.with_suffix(".csv")
    with whole_file(page) as partial:
        partial.write_text(markdown(cells, baselines), encoding="utf-8")
    with whole_file(table) as partial:
        cells.to_csv(partial, index=False)
    return [page, table]
