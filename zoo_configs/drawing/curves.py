"""Learning curves: success in the evaluations over time steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from zoo_configs.errors import refused
from zoo_configs.experiments.families import task_name
from zoo_configs.files import whole_file

PANEL_SIZE = (4.2, 3.2)  # inches, with text of 12 points: readable where two panels share 400 pixels
FONT_SIZE = 12
PANELS_A_ROW = 2
DOTS_PER_INCH = 200
COLORS, STYLES = 10, ("-", "--", ":", "-.")  # the number of matplotlib's colours, then the next line style
SUCCESS, RETURN = "evaluation success rate", "evaluation return"
TIMESTEPS = "timesteps"
QUANTITIES = {"value": "critic value", "entropy": "policy entropy (nats)"}
SIDES = {"expert": "-", "online": "--"}
"""Line style by kind of transitions."""


@dataclass(frozen=True)
class LearningCurve:
    """
    Evaluations of a run, or their mean over several runs.

    :param timesteps: Time steps of the evaluations, shape (n,)
    :param success: Mean success in [0, 1], shape (n,); mean return if the environment reports no success
    :param error: Standard error of that mean over the episodes of one run or over runs, shape (n,); NaN if
        only one of several runs was evaluated
    :param measure: Label of the axis
    :param episodes: Number of episodes of each evaluation of one run
    """

    timesteps: npt.NDArray[np.int64]
    success: npt.NDArray[np.float64]
    error: npt.NDArray[np.float64]
    measure: str
    episodes: int = 0


def load_curve(path: Path) -> LearningCurve:
    """Read ``evaluations.npz`` of a run, which has Stable-Baselines3's format."""
    with refused(f"{path} is damaged"), np.load(path) as saved:
        has_success = "successes" in saved
        episodes = np.asarray(saved["successes" if has_success else "results"], dtype=np.float64)
        timesteps = saved["timesteps"]
        error = episodes.std(axis=1) / np.sqrt(episodes.shape[1])
    measure = SUCCESS if has_success else RETURN
    return LearningCurve(timesteps, episodes.mean(axis=1), error, measure, episodes.shape[1])


def read_training_log(path: Path) -> pd.DataFrame:
    """Read the table of a run; raise ``CommandError`` if it is damaged."""
    with refused(f"{path} is damaged"):
        return pd.read_csv(path).astype({TIMESTEPS: int})


def mean_curve(curves: Sequence[LearningCurve]) -> LearningCurve:
    """Return the mean of runs with one measure, at each time step over the runs that were evaluated then."""
    if len(curves) == 1:
        return curves[0]
    table = pd.concat([pd.Series(curve.success, curve.timesteps) for curve in curves], axis=1).sort_index()
    mean, error = table.mean(axis=1).to_numpy(), table.sem(axis=1).to_numpy()
    return LearningCurve(table.index.to_numpy(), mean, error, curves[0].measure, curves[0].episodes)


def draw_curves(panels: Mapping[str, Mapping[str, LearningCurve]], path: Path) -> None:
    """Draw learning curves by environment (panel) and label; shading is the standard error."""
    columns = min(len(panels), PANELS_A_ROW)
    rows = -(-len(panels) // columns)
    figure, grid = _subplots(rows, columns)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    lines: dict[str, Any] = {}
    for axes, (env_id, curves) in zip(grid.flat, panels.items(), strict=False):
        for name, curve in curves.items():
            lines[name] = _draw(axes, curve, names.index(name))  # the same colour in all panels
        measure = next(iter(curves.values())).measure.removeprefix("evaluation ")
        axes.set_title(task_name(env_id), fontsize=FONT_SIZE)  # a whole id is wider than a panel
        axes.set_ylabel(measure)
        if all(curve.measure == SUCCESS for curve in curves.values()):
            axes.set_ylim(-0.02, 1.02)
    _save(figure, lines, path)


def draw_training(panels: Mapping[str, Mapping[str, Sequence[Path]]], path: Path) -> None:
    """Draw the means over runs of values and entropy, from training logs (CSV) by environment and label."""
    figure, grid = _subplots(len(panels), len(QUANTITIES))
    lines: dict[str, Any] = {}
    for row, (env_id, logs) in zip(grid, panels.items(), strict=True):
        for axes, (quantity, label) in zip(row, QUANTITIES.items(), strict=True):
            axes.set_title(task_name(env_id), fontsize=FONT_SIZE)
            axes.set_ylabel(label)
            for number, (name, files) in enumerate(logs.items()):
                means = pd.concat(map(read_training_log, files)).groupby(TIMESTEPS).mean()
                for side, style in SIDES.items():
                    if (column := f"{quantity}_{side}") in means:
                        values = means[column].dropna()
                        (line,) = axes.plot(values.index, values, style, color=f"C{number % COLORS}")
                        lines[f"{name}, {side} transitions"] = line
    _save(figure, lines, path)


def _subplots(rows: int, columns: int) -> tuple[Any, Any]:
    from matplotlib import rc_context
    from matplotlib.figure import Figure  # unlike pyplot, it needs no display and keeps no state
    from matplotlib.ticker import EngFormatter, MaxNLocator

    size = (columns * PANEL_SIZE[0], rows * PANEL_SIZE[1])
    with rc_context({"font.size": FONT_SIZE}):
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.grid(alpha=0.3)
        axes.set_xlabel("time steps")
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 5k
    return figure, grid


def _save(figure: Any, lines: Mapping[str, Any], path: Path) -> None:
    """Write a figure with one legend below its panels."""
    columns = figure.axes[0].get_gridspec().ncols
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=columns)
    with whole_file(path) as partial:  # a legend can be wider than the panels
        figure.savefig(partial, dpi=DOTS_PER_INCH, bbox_inches="tight")


def _draw(axes: Any, curve: LearningCurve, number: int) -> Any:
    color, style = f"C{number % COLORS}", STYLES[number // COLORS % len(STYLES)]
    (line,) = axes.plot(curve.timesteps, curve.success, style, marker="o", markersize=3, color=color)
    low, high = curve.success - curve.error, curve.success + curve.error
    axes.fill_between(curve.timesteps, low, high, color=color, alpha=0.2, linewidth=0)
    return line
