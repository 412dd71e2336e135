"""What a training command has decided to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.cells.cell import Cell

if TYPE_CHECKING:
    from zoo_configs.training.runs import Run


@dataclass(frozen=True)
class Plan:
    """
    What is to be trained.

    :param cell: The cell
    :param arguments: Arguments for ``rl_zoo3.train``
    :param run: The run to go on with, None for a new one
    :param checkpoint: The checkpoint to go on from, None for a new run
    :param gym_packages: Packages that register the environment, besides our own
    """

    cell: Cell
    arguments: tuple[str, ...]
    run: Run | None = None
    checkpoint: Path | None = None
    gym_packages: tuple[str, ...] = ()
