"""What the workbench costs: ``train_cell`` beside a bare ``model.learn()``."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from typing import NamedTuple

from zoo_configs.cells.cell import Cell
from zoo_configs.measuring.update_speed import make_model
from zoo_configs.training.cell import train_cell
from zoo_configs.training.options import TrainingOptions

PAIRS = 5


class Overhead(NamedTuple):
    """
    The same training in two ways, in CPU seconds of the process, in pairs that follow each other.

    :param bare: Environment, model and ``model.learn()``, of each pair
    :param workbench: ``train_cell``: with its checks, run folder, logs, monitor and checkpoints
    """

    bare: tuple[float, ...]
    workbench: tuple[float, ...]

    @property
    def shares(self) -> list[float]:
        """What the workbench adds, as a share of the bare training: of each pair, the least first."""
        return sorted(ours / bare - 1 for ours, bare in zip(self.workbench, self.bare, strict=True))


def measure_overhead(cell: Cell, n_timesteps: int, device: str = "auto", pairs: int = PAIRS) -> Overhead:
    """
    Train a cell bare and by the workbench, without evaluations, which take as long as they are asked to.

    The two take turns to be first: a machine that grows faster or slower favours neither.

    :param cell: The cell, in one environment
    :param n_timesteps: Time steps of either training
    :param device: PyTorch device
    :param pairs: How often both are trained
    :return: The CPU seconds of both
    """
    options = TrainingOptions.of(cell, {"n_timesteps": n_timesteps, "eval_freq": 0, "verbose": 0})

    def bare() -> None:
        model = make_model(cell, device)
        model.learn(n_timesteps)
        if model.env is not None:
            model.env.close()

    def workbench() -> None:
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            train_cell(cell, 0, device, folder, options=options)

    workbench()  # compiles, fills caches
    seconds: dict[Callable[[], None], list[float]] = {bare: [], workbench: []}
    for pair in range(pairs):
        for train in (bare, workbench) if pair % 2 == 0 else (workbench, bare):
            seconds[train].append(_seconds(train))
    return Overhead(tuple(seconds[bare]), tuple(seconds[workbench]))


def _seconds(function: Callable[[], None]) -> float:
    """CPU seconds of a call: what other processes do at the time counts little."""
    start = time.process_time()
    function()
    return time.process_time() - start
