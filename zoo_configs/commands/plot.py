"""``bulletarm-zoo plot``: draws the learning curves of many runs."""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, print_written

if TYPE_CHECKING:
    from zoo_configs.results import ExperimentResults

DESCRIPTION = """Draw the evaluations of all runs in a log folder: a panel for each environment and a curve
for each experiment, with the mean over the seeds and its standard error. Runs of an experiment differ only
in their seeds. Experiments with the same baseline are labelled with the settings that differ. Print tables of
the experiments and of the baselines over all tasks, and write them next to the figure."""
PICTURE, TRAINING_PICTURE = "learning_curves.png", "training_curves.png"
FORMATS = (".png", ".pdf", ".svg")


def main(argv: Sequence[str]) -> None:
    """Run the command."""
    args = _parse(argv)
    from zoo_configs.results import read_experiments

    output = args.output or args.log_folder / (TRAINING_PICTURE if args.training else PICTURE)
    check_writable(output, "--output")
    experiments = read_experiments(args.log_folder, args.env, args.baseline)
    written = _plot_training(experiments, output) if args.training else _plot_success(experiments, output)
    print_written(*written)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo plot", description=DESCRIPTION)
    add = parser.add_argument
    add("--env", nargs="+", help="environment ids (default: all)")
    add("--baseline", nargs="+", help="baselines (default: all)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
    kinds = ", ".join(FORMATS)
    add("-o", "--output", type=Path, help=f"{kinds} file to write (default: {PICTURE} in the log folder)")
    add("--training", action="store_true", help="draw critic values and policy entropy instead")
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix not in FORMATS:
        parser.error(f"--output must end in {kinds}, got {args.output}")
    return args


def _plot_success(experiments: Sequence[ExperimentResults], output: Path) -> list[Path]:
    from zoo_configs.drawing.curves import LearningCurve, draw_curves, mean_curve
    from zoo_configs.results import BASELINE_HEADS, HEADS, baseline_rows, experiment_row, write_tables

    print_table(HEADS, list(map(experiment_row, experiments)))
    print_table(BASELINE_HEADS, baseline_rows(experiments))
    panels: defaultdict[str, dict[str, LearningCurve]] = defaultdict(dict)
    for experiment in experiments:
        curves = [result.curve for result in experiment.results.values()]
        panels[experiment.env_id][experiment.label] = mean_curve(curves)
    draw_curves(panels, output)
    return [output, *write_tables(experiments, output)]


def _plot_training(experiments: Iterable[ExperimentResults], output: Path) -> list[Path]:
    from zoo_configs.drawing.curves import draw_training

    panels: defaultdict[str, dict[str, list[Path]]] = defaultdict(dict)
    for experiment in experiments:
        logs = [result.run.training_log for result in experiment.results.values()]
        if existing := [path for path in logs if path.is_file()]:
            panels[experiment.env_id][experiment.label] = existing
    if not panels:
        raise CommandError("no run has logged its updates")
    draw_training(panels, output)
    return [output]
