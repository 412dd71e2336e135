"""Curves of critic values and policy entropy, separately for expert and online transitions."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from zoo_configs.drawing.curves import DOTS_PER_INCH, PANEL_SIZE
from zoo_configs.errors import refused
from zoo_configs.files import whole_file
from zoo_configs.training.training_log import TIMESTEPS

QUANTITIES = {"value": "critic value", "entropy": "policy entropy (nats)"}
SIDES = {"expert": ("-", "expert"), "own": ("--", "online")}  # line style and name, by column suffix


def draw_training(panels: Mapping[str, Mapping[str, Sequence[Path]]], path: Path) -> None:
    """
    Draw values and entropy into one figure: a row for each environment, means over runs.

    :param panels: Training logs (CSV) by environment and label
    :param path: File to write
    """
    from matplotlib.figure import Figure  # unlike pyplot, it needs no display and keeps no state

    width, height = PANEL_SIZE
    figure = Figure(figsize=(len(QUANTITIES) * width, len(panels) * height), layout="constrained")
    grid = figure.subplots(len(panels), len(QUANTITIES), squeeze=False)
    for row, (env_id, logs) in zip(grid, panels.items(), strict=True):
        for axes, (quantity, label) in zip(row, QUANTITIES.items(), strict=True):
            axes.set(title=env_id, xlabel="time steps", ylabel=label)
            axes.grid(alpha=0.3)
            for number, (name, files) in enumerate(logs.items()):
                _draw(axes, f"C{number % 10}", name, quantity, files)
            axes.legend()
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=DOTS_PER_INCH)


def _draw(axes: Any, color: str, name: str, quantity: str, files: Sequence[Path]) -> None:
    for side, (style, transitions) in SIDES.items():
        values = _read(files, f"{quantity}_{side}")
        if values:
            means = [np.mean(values[step]) for step in sorted(values)]
            label = f"{name}, {transitions} transitions"
            axes.plot(sorted(values), means, style, color=color, label=label)


def _read(files: Sequence[Path], column: str) -> Mapping[float, list[float]]:
    """Return the values of a column of all files by time step."""
    values: defaultdict[float, list[float]] = defaultdict(list)
    for path in files:
        with refused(f"{path} is damaged"), path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                if row.get(column):
                    values[float(row[TIMESTEPS])].append(float(row[column]))
    return values
