"""Learning curves: evaluation success over time steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from zoo_configs.errors import refused
from zoo_configs.files import whole_file
from zoo_configs.training.runs import CURVE_FILE, Run

PANEL_SIZE = (6.4, 4.0)  # inches
CURVES_BESIDE_LEGEND = 3  # a legend of more would cover them: it stands outside
PANELS_A_ROW = 2
DOTS_PER_INCH = 150


@dataclass(frozen=True)
class LearningCurve:
    """
    What the periodic evaluations of a run, or of several on the mean, measured.

    :param timesteps: When they took place, shape (n,)
    :param success: Mean success, in [0, 1], shape (n,); mean return where the environment reports no success
    :param error: Standard error of that mean, over the episodes of one run or over runs, shape (n,)
    :param measure: What ``success`` holds, for the axis
    """

    timesteps: npt.NDArray[np.int64]
    success: npt.NDArray[np.float64]
    error: npt.NDArray[np.float64]
    measure: str


def load_curve(path: Path) -> LearningCurve:
    """
    Read the evaluations of a run.

    :param path: Its ``evaluations.npz``, as Stable-Baselines3 writes it
    :return: The curve
    :raises CommandError: if it cannot be read
    """
    with refused(f"{path} is damaged"), np.load(path) as saved:
        has_success = "successes" in saved
        episodes = np.asarray(saved["successes" if has_success else "results"], dtype=np.float64)
        timesteps = saved["timesteps"]
    error = episodes.std(axis=1) / np.sqrt(episodes.shape[1])
    measure = "evaluation success rate" if has_success else "evaluation return"
    return LearningCurve(timesteps, episodes.mean(axis=1), error, measure)


def mean_curve(curves: Sequence[LearningCurve]) -> LearningCurve:
    """
    The mean of runs, where all of them were evaluated.

    :param curves: One a run, at least one, of one measure
    :return: The mean; its error is the standard error over runs, that over episodes if there is only one
    :raises ValueError: if there is no time step at which all were evaluated
    """
    if len(curves) == 1:
        return curves[0]
    timesteps = reduce(np.intersect1d, [curve.timesteps for curve in curves])
    if not len(timesteps):
        raise ValueError(f"its {len(curves)} runs were never evaluated at the same time step")
    success = np.stack([curve.success[np.isin(curve.timesteps, timesteps)] for curve in curves])
    error = success.std(axis=0, ddof=1) / np.sqrt(len(curves))
    return LearningCurve(timesteps, success.mean(axis=0), error, curves[0].measure)


def draw_run(run: Run) -> Path:
    """
    Draw the learning curve of a run into its folder.

    :param run: The run; it has at least one evaluation
    :return: The picture
    """
    path = run.folder / CURVE_FILE
    draw_curves({run.cell.env_id: {run.cell.label: load_curve(run.evaluations_file)}}, path)
    return path


def draw_curves(panels: Mapping[str, Mapping[str, LearningCurve]], path: Path) -> None:
    """
    Draw learning curves into one picture, a panel an environment; shading denotes the standard error.

    :param panels: Of each environment the curves by their names in the legend
    :param path: The PNG to write
    """
    from matplotlib.figure import Figure  # not pyplot: needs no display and keeps no state

    columns = min(len(panels), PANELS_A_ROW)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(columns * PANEL_SIZE[0], rows * PANEL_SIZE[1]), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).flat
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, (title, curves) in zip(grid, panels.items(), strict=False):
        _draw_panel(axes, title, curves)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=DOTS_PER_INCH)


def _draw_panel(axes: Any, title: str, curves: Mapping[str, LearningCurve]) -> None:
    for name, curve in curves.items():
        _draw(axes, name, curve)
    axes.set(title=title, xlabel="time steps", ylabel=next(iter(curves.values())).measure)
    if all("success" in curve.measure for curve in curves.values()):
        axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.3)
    if len(curves) > CURVES_BESIDE_LEGEND:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    else:
        axes.legend(loc="lower right")


def _draw(axes: Any, name: str, curve: LearningCurve) -> None:
    (line,) = axes.plot(curve.timesteps, curve.success, marker="o", markersize=3, label=name)
    low, high = curve.success - curve.error, curve.success + curve.error
    axes.fill_between(curve.timesteps, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
