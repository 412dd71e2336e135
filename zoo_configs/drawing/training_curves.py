"""Curves of what algorithms logged of their updates: values and entropy, expert's and agent's apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from zoo_configs.drawing.curves import DOTS_PER_INCH, PANEL_SIZE
from zoo_configs.files import whole_file
from zoo_configs.training.training_log import TIMESTEPS

QUANTITIES = {"value": "critic's value", "entropy": "actor's entropy (nats)"}
SIDES = {"expert": "-", "own": "--"}  # where the expert was, where the agent was


def draw_training(panels: Mapping[str, Mapping[str, Sequence[pd.DataFrame]]], path: Path) -> None:
    """
    Draw values and entropy into one picture: a row an environment, means over runs.

    :param panels: Of each environment and baseline the tables of its runs
    :param path: The PNG to write
    """
    from matplotlib.figure import Figure  # not pyplot: needs no display and keeps no state

    width, height = PANEL_SIZE
    figure = Figure(figsize=(len(QUANTITIES) * width, len(panels) * height), layout="constrained")
    grid = figure.subplots(len(panels), len(QUANTITIES), squeeze=False)
    for row, (env_id, baselines) in zip(grid, panels.items(), strict=True):
        for axes, (quantity, label) in zip(row, QUANTITIES.items(), strict=True):
            axes.set(title=env_id, xlabel="time steps", ylabel=label)
            axes.grid(alpha=0.3)
            for number, (name, tables) in enumerate(baselines.items()):
                _draw(axes, f"C{number % 10}", name, quantity, tables)
            axes.legend()
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=DOTS_PER_INCH)


def _draw(axes: Any, color: str, name: str, quantity: str, tables: Sequence[pd.DataFrame]) -> None:
    mean = pd.concat(tables).groupby(TIMESTEPS).mean()
    for side, style in SIDES.items():
        if (column := f"{quantity}_{side}") in mean:
            line = mean[column].dropna()
            axes.plot(line.index, line, style, color=color, label=f"{name}, {side} transitions")
