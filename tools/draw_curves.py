"""Draw the learning curves of a CSV file, to which the runs of a log folder can be added.

python tools/draw_curves.py docs/data/six_baselines.csv -f six_baselines -o docs/images/comparison.png
python tools/draw_curves.py docs/data/demonstrations.csv --over expert_episodes -o demonstrations.png
"""

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib.figure import Figure

from measurements import DataFile, Row, number
from zoo_configs.drawing.curves import SUCCESS, LearningCurve, draw_curves, mean_curve
from zoo_configs.experiments.families import task_name
from zoo_configs.results import Result, read_experiments
from zoo_configs.training.runs import Run

KEY = ("env", "baseline", "seed")
ENDS = {-1: "-", 0: ":"}
"""Line style of the last and of the first evaluation."""


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("data", type=Path, help="CSV of evaluations, one row a run")
    add("-f", "--log-folder", type=Path, help="folder of runs to add to the file")
    how = "setting on the horizontal axis instead of the time steps, of tasks with several values"
    add("--over", metavar="NAME", help=how)
    add("-o", "--output", type=Path, required=True, help="PNG file to write")
    args = parser.parse_args()
    data = DataFile(args.data, KEY)
    for experiment in read_experiments(args.log_folder) if args.log_folder else ():
        for result in experiment.results.values():
            label = with_setting(result.run, args.over) if args.over else experiment.label
            data.add(to_row(result, label))
    panels: defaultdict[str, defaultdict[str, list[LearningCurve]]] = defaultdict(lambda: defaultdict(list))
    for row in sorted(data.read(), key=lambda row: row["env"]):
        panels[row["env"]][row["baseline"]].append(to_curve(row))
    if args.over:
        lines = {env: by_setting(labels, args.over) for env, labels in panels.items()}
        several = {env: points for env, points in lines.items() if len(points) > 1}
        draw_setting(several, args.over, args.output)
        return
    means = {
        env: {name: mean_curve(curves) for name, curves in lines.items()} for env, lines in panels.items()
    }
    draw_curves(means, args.output)


def with_setting(run: Run, name: str) -> str:
    """Return the baseline with one setting, which its other runs need not have with another value."""
    return f"{run.experiment.label}, {name}={run.experiment.hyperparams[name]}"


def to_row(result: Result, label: str) -> Row:
    """Return the row of a run."""
    run, curve, origin = result.run, result.curve, result.origin
    evaluations = zip(curve.timesteps, curve.success, strict=True)
    return {
        "env": run.experiment.env_id,
        "baseline": label,
        "seed": str(run.seed),
        "measure": curve.measure,
        "episodes": str(curve.episodes),
        "evaluations": " ".join(f"{step}:{number(value, 4)}" for step, value in evaluations),
        "state": run.status.state.value,
        "minutes": number(float("nan") if origin.minutes is None else origin.minutes, 1),
        **{name: getattr(origin, name) for name in ("machine", "date", "commit", "command")},
    }


def to_curve(row: Row) -> LearningCurve:
    """Return the curve of a row; its standard error is NaN for returns."""
    pairs = [pair.split(":") for pair in row["evaluations"].split()]
    success, episodes = np.array([float(value) for _, value in pairs]), int(row["episodes"])
    variance = success * (1 - success) if row["measure"] == SUCCESS else np.full(len(pairs), np.nan)
    steps = np.array([int(step) for step, _ in pairs])
    return LearningCurve(steps, success, np.sqrt(variance / episodes), row["measure"], episodes)


def by_setting(labels: dict[str, list[LearningCurve]], name: str) -> dict[int, list[LearningCurve]]:
    """Return the curves of all seeds by the value of a setting, in ascending order."""
    found = {
        int(label.partition(f"{name}=")[2].partition(",")[0]): curves for label, curves in labels.items()
    }
    return dict(sorted(found.items()))


def draw_setting(lines: dict[str, dict[int, list[LearningCurve]]], name: str, path: Path) -> None:
    """Draw the first and the last evaluation over a setting: a line for their mean, a dot for each seed."""
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    axes = figure.subplots()
    for color, (env, points) in enumerate(lines.items()):
        for end, style in ENDS.items():
            means = [fmean(ends_of(curves, end)) for curves in points.values()]
            label = f"{task_name(env)}, {'last' if end else 'first'} evaluation"
            axes.plot(list(points), means, style, color=f"C{color}", label=label)
        for value, curves in points.items():
            axes.plot([value] * len(curves), ends_of(curves, -1), "o", color=f"C{color}", markersize=3)
    axes.set_xscale("log")
    axes.set_xticks(ticks := list(next(iter(lines.values()))), list(map(str, ticks)))
    axes.minorticks_off()
    axes.set(xlabel=name, ylabel="success rate", ylim=(0.0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=200)


def ends_of(curves: Sequence[LearningCurve], end: int) -> list[float]:
    """Return the success of the first (0) or last (-1) evaluation of each run."""
    return [float(curve.success[end]) for curve in curves]


if __name__ == "__main__":
    main()
