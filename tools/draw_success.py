"""Draw the success rates and minutes of docs/data/results.csv, one bar a task and one dot a seed.

python tools/draw_success.py CloseLoop -o docs/images/success_closed_loop.png
"""

import argparse
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib.figure import Figure

from measurements import DATA, DataFile, runs_of_tasks


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("control", help="start of the names of the tasks")
    parser.add_argument("-o", "--output", type=Path, required=True, help="PNG file to write")
    args = parser.parse_args()
    results = [row for row in DataFile(DATA / "results.csv", ()).read() if row["last"]]
    tasks = {task: runs for task, runs in runs_of_tasks(results).items() if task.startswith(args.control)}
    figure = Figure(figsize=(5.2, 0.9 + 0.24 * len(tasks)), layout="constrained")
    axes = figure.subplots()
    for mean, task in sorted((fmean(float(row["last"]) for row in tasks[task]), task) for task in tasks):
        label = task.removeprefix(args.control)
        minutes = [float(row["minutes"] or "nan") for row in tasks[task]]
        axes.barh(label, mean, 0.7, color="#7f9fc4")
        for row in tasks[task]:
            axes.plot(float(row["last"]), label, "o", color="#b8650f", markersize=4, clip_on=False)
        duration = "" if np.isnan(minutes).all() else f", {np.nanmean(minutes):.0f} min"
        axes.text(1.04, label, f"{mean:.2f}{duration}", va="center")
    axes.set(xlim=(0.0, 1.0), xlabel="success rate in 100 episodes (dots: seeds), time of training")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(args.output, dpi=200)


if __name__ == "__main__":
    main()
