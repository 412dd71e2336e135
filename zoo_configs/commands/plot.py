"""``bulletarm-zoo plot``: draws the learning curves of many runs."""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

from zoo_configs.drawing.curves import LearningCurve, draw_curves, draw_training, mean_curve
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, print_written
from zoo_configs.results import (
    BASELINE_HEADS,
    HEADS,
    ExperimentResults,
    baseline_rows,
    experiment_row,
    read_experiments,
    write_tables,
)

FIGURE, TRAINING_FIGURE = "learning_curves.png", "training_curves.png"


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    output = args.output or args.log_folder / (TRAINING_FIGURE if args.training else FIGURE)
    env_ids = args.env and [env_id.rpartition(":")[2] for env_id in args.env]
    experiments = read_experiments(args.log_folder, env_ids, args.baseline, args.seed, args.device)
    check_writable(output, "--output")
    written = _plot_training(experiments, output) if args.training else _plot_success(experiments, output)
    print_written(*written)


def _plot_success(experiments: Sequence[ExperimentResults], output: Path) -> list[Path]:
    print_table(HEADS, list(map(experiment_row, experiments)))
    print_table(BASELINE_HEADS, baseline_rows(experiments))
    panels: defaultdict[str, dict[str, LearningCurve]] = defaultdict(dict)
    for experiment in experiments:
        curves = [result.curve for result in experiment.results.values()]
        panels[experiment.env_id][experiment.label] = mean_curve(curves)
    draw_curves(panels, output)
    return [output, *write_tables(experiments, output)]


def _plot_training(experiments: Iterable[ExperimentResults], output: Path) -> list[Path]:
    panels: defaultdict[str, dict[str, list[Path]]] = defaultdict(dict)
    for experiment in experiments:
        logs = [result.run.training_log for result in experiment.results.values()]
        if existing := [path for path in logs if path.is_file()]:
            panels[experiment.env_id][experiment.label] = existing
    if not panels:
        raise CommandError("no run has logged its updates")
    draw_training(panels, output)
    return [output]
