"""Draw the learning curves of a CSV file, to which the runs of a log folder can be added.

python tools/draw_curves.py docs/data/six_baselines.csv -f six_baselines -o docs/images/comparison.png
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from measurements import DataFile, Row, number
from zoo_configs.drawing.curves import SUCCESS, LearningCurve, draw_curves, load_curve, mean_curve
from zoo_configs.training.runs import Run, find_runs, origin_of

KEY = ("env", "baseline", "seed")


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("data", type=Path, help="CSV of evaluations, one row a run")
    add("-f", "--log-folder", type=Path, help="folder of runs to add to the file")
    add("-o", "--output", type=Path, required=True, help="PNG file to write")
    args = parser.parse_args()
    data = DataFile(args.data, KEY)
    for run in find_runs(args.log_folder) if args.log_folder else ():
        if run.evaluations_file.is_file():
            data.add(to_row(run))
    panels: defaultdict[str, defaultdict[str, list[LearningCurve]]] = defaultdict(lambda: defaultdict(list))
    for row in sorted(data.read(), key=lambda row: (row["env"], row["baseline"])):
        panels[row["env"]][row["baseline"]].append(to_curve(row))
    means = {
        env: {name: mean_curve(curves) for name, curves in lines.items()} for env, lines in panels.items()
    }
    draw_curves(means, args.output)


def to_row(run: Run) -> Row:
    """Return the row of a run."""
    curve, origin = load_curve(run.evaluations_file), origin_of(run)
    evaluations = zip(curve.timesteps, curve.success, strict=True)
    return {
        "env": run.experiment.env_id,
        "baseline": run.experiment.label,
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


if __name__ == "__main__":
    main()
