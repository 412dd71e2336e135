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


class Overhead(NamedTuple):
    """
    The same training in two ways, in CPU seconds of the process.

    :param bare: Environment, model and ``model.learn()``
    :param workbench: ``train_cell``: with its checks, run folder, logs, monitor and checkpoints
    """

    bare: float
    workbench: float

    @property
    def share(self) -> float:
        """What the workbench adds, as a share of the bare training."""
        return self.workbench / self.bare - 1


def measure_overhead(cell: Cell, n_timesteps: int, device: str = "auto") -> Overhead:
    """
    Train a cell bare and by the workbench, without evaluations, which take as long as they are asked to.

    :param cell: The cell, in one environment
    :param n_timesteps: Time steps of either training
    :param device: PyTorch device
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

    make_model(cell, device).learn(1)  # compiles, fills caches
    return Overhead(_seconds(bare), _seconds(workbench))


def _seconds(function: Callable[[], None]) -> float:
    """CPU seconds of a call: what other processes do at the time counts little."""
    start = time.process_time()
    function()
    return time.process_time() - start
