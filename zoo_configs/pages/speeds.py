"""Tables and sentences of how fast environments step and learners learn."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from zoo_configs.drawing.tables import markdown_table
from zoo_configs.measuring.data_files import OVERHEAD, SPEED, UPDATES, Record
from zoo_configs.pages.markers import Source, origins

HEADS = {
    "yardstick_us": "yardstick us",
    "steps_per_second": "steps/s",
    "step_ms": "ms/step",
    "physics_ms": "physics",
    "rendering_ms": "rendering",
    "rest_ms": "rest",
    "without_expert_ms": "without expert",
    "unsimulated": "steps without simulation",
    "reset_ms": "reset ms",
    "reference_steps_per_second": "reference steps/s",
    "times_reference": "ratio",
}
DIGITS = {"steps_per_second": 0, "reset_ms": 1, "yardstick_us": 1, "times_reference": 1}
DIGITS["reference_steps_per_second"] = 1
PARTS = ("gradients_of_convolutions", "convolutions", "pooling", "rest")


def speed_table(source: Source) -> str:
    """
    Tell how fast environments step.

    :param source: The data
    :return: Markdown
    """
    rows = _default(source)
    heads = ["environment", *HEADS.values(), "expert"]
    lines = [[f"`{row['env']}`", *(_figure(row, column) for column in HEADS), _expert(row)] for row in rows]
    load = f"load average when a row began at most {max(float(row['load']) for row in rows):.1f}"
    return "\n\n".join([markdown_table(heads, lines), f"{origins(rows)}, {load} ({source.link('speed')})."])


def ratio_sentence(source: Source) -> str:
    """
    Compare with the reference.

    :param source: The data
    :return: A sentence for a page about speed
    """
    told = []
    for control, tasks in (
        ("CloseLoop", "the {} close-loop tasks of the paper"),
        ("OpenLoop", "its {} open-loop tasks"),
    ):
        ratios = _ratios(source, control)
        told.append(f"{_mean(ratios):.1f} for {tasks.format(len(ratios))} (the least {min(ratios):.1f})")
    return f"The geometric mean of the ratios is {' and '.join(told)}."


def ratio_summary(source: Source) -> str:
    """
    Compare with the reference, in short.

    :param source: The data
    :return: A sentence for a first page
    """
    close, opened = _ratios(source, "CloseLoop"), _ratios(source, "OpenLoop")
    both = (*close, *opened)
    return (
        f"Steps {min(both):.0f} to {max(both):.0f} times as fast as the original release's; on the geometric "
        f"mean {_mean(close):.0f} times in close loop, {_mean(opened):.0f} times in open loop"
    )


def update_table(source: Source, belongs: Callable[[str], bool]) -> str:
    """
    Tell how long updates take, and what the time goes to.

    :param source: The data
    :param belongs: Those on which environments, by their names
    :return: Markdown
    """
    rows = [row for row in source.read("updates", UPDATES) if belongs(row["env"])]
    heads = ["baseline", "preset", "device", "ms an update", "peak GB"]
    heads += [*(part.replace("_", " ") for part in PARTS), "equivariant over plain"]
    lines = [
        [
            *(f"`{row['baseline']}`", f"`{row['preset']}`", row["device"], f"{float(row['update_ms']):,.1f}"),
            *(row["peak_gigabytes"], *(_percent(row[part]) for part in PARTS), row["equivariant_over_plain"]),
        ]
        for row in rows
    ]
    return "\n\n".join([markdown_table(heads, lines), f"{origins(rows)} ({source.link('updates')})."])


def overhead_table(source: Source) -> str:
    """
    Tell what the workbench adds to a training.

    :param source: The data
    :return: Markdown
    """
    rows = source.read("overhead", OVERHEAD)
    heads = ["baseline", "time steps", "model.learn() CPU s", "train CPU s", "overhead", "its range"]
    lines = [
        [
            *(f"`{row['baseline']}`", row["timesteps"], row["bare_seconds"], row["train_seconds"]),
            *(_percent(row["overhead"], 1), f"{_percent(row['least'], 1)} to {_percent(row['greatest'], 1)}"),
        ]
        for row in rows
    ]
    return "\n\n".join([markdown_table(heads, lines), f"{origins(rows)} ({source.link('overhead')})."])


def _default(source: Source) -> list[Record]:
    """Environments with their default parameters."""
    return [row for row in source.read("speed", SPEED) if not row["env_kwargs"]]


def _figure(row: Record, column: str) -> str:
    return f"{float(row[column]):.{DIGITS.get(column, 2)}f}" if row[column] else ""


def _expert(row: Record) -> str:
    return f"{float(row['success']):.2f} of {row['episodes']}"


def _ratios(source: Source, control: str) -> list[float]:
    rows = [row for row in _default(source) if row["times_reference"] and row["env"].startswith(control)]
    return [float(row["times_reference"]) for row in rows]


def _mean(ratios: Sequence[float]) -> float:
    """Geometric mean."""
    return math.exp(sum(map(math.log, ratios)) / len(ratios))


def _percent(share: str, digits: int = 0) -> str:
    return f"{float(share) * 100:.{digits}f} %" if share else ""
