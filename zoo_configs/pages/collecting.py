"""Table of how fast demonstrations are collected."""

from __future__ import annotations

from zoo_configs.drawing.tables import markdown_table
from zoo_configs.measuring.data_files import COLLECTING
from zoo_configs.pages.markers import Source, origins

HEADS = ("id `BulletArm/...-v0`", "episodes", "attempts", "steps", "a minute", "load")


def deconstruction_table(source: Source) -> str:
    """
    Tell how structures are built by taking them apart.

    :param source: The data
    :return: Markdown
    """
    rows = [row for row in source.read("collecting", COLLECTING) if row["planner"] == "deconstruction"]
    figures = ("episodes", "attempts", "mean_steps", "episodes_per_minute", "load")
    lines = [[f"`{row['env']}`", *(row[column] for column in figures)] for row in rows]
    return "\n\n".join([markdown_table(HEADS, lines), f"{origins(rows)} ({source.link('collecting')})."])
