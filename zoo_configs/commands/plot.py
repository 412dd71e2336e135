"""``bulletarm-zoo plot``: draws the learning curves of many runs into one picture."""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable

if TYPE_CHECKING:
    import pandas as pd

    from zoo_configs.benchmarking.evaluated import EvaluatedRun
    from zoo_configs.drawing.curves import LearningCurve
    from zoo_configs.training.runs import Run

DESCRIPTION = """Draw the evaluations of all runs in a log folder, or in that of a benchmark, as the paper
does: a panel an environment, a line a baseline, the mean over its runs (seeds) shaded by their standard
error. Prints tables of the cells and of the baselines over all tasks, and writes them beside the picture
(Markdown, CSV). Evaluations can be kept in a file, and drawn from it when the runs are gone."""
LOG_FOLDER = Path("logs")
PICTURE, TRAINING_PICTURE = "learning_curves.png", "training_curves.png"
FORMATS = (".png", ".pdf", ".svg")


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no run to draw
    """
    args = _parse(argv)
    name, folder = (TRAINING_PICTURE if args.training else PICTURE), args.log_folder or args.data.parent
    output = args.output or folder / name
    check_writable(output, "--output")
    written = (_plot_training if args.training else _plot_success)(args, output)
    print("\n".join(["Written:", *(f"  {path}" for path in written)]))


def _plot_success(args: argparse.Namespace, output: Path) -> list[Path]:
    from zoo_configs.benchmarking.results import baseline_table, cell_table, run_table
    from zoo_configs.benchmarking.tables import (
        BASELINE_HEADS,
        CELL_HEADS,
        baseline_rows,
        cell_rows,
        write_tables,
    )

    runs = _runs_to_draw(args)
    table = run_table(runs)
    cells, baselines = cell_table(table), baseline_table(table)
    print_table(CELL_HEADS, cell_rows(cells), args.markdown)
    print_table(BASELINE_HEADS, baseline_rows(baselines), args.markdown)
    draw_panels(runs, output)
    return [output, *write_tables(cells, baselines, output), *([args.data] if args.data else [])]


def _runs_to_draw(args: argparse.Namespace) -> list[EvaluatedRun]:
    """Those of the log folder; with a file of curves all of this, to which they are added."""
    from zoo_configs.benchmarking.evaluated import EvaluatedRun, keep_curves

    found: list[Run] = []
    if args.log_folder is not None:
        found = evaluated_runs(args.log_folder, args.env, args.baseline)
    runs = [EvaluatedRun.of(run) for run in found]
    if args.data is None:
        return runs
    check_writable(args.data, "--data")
    kept = [
        run
        for run in keep_curves(runs, args.data)
        if _is_wanted(run.env_id, run.baseline, args.env, args.baseline)
    ]
    if not kept:
        raise CommandError(f"no run of these environments and baselines in {args.data}")
    return kept


def draw_panels(runs: Iterable[EvaluatedRun], output: Path) -> None:
    """
    Draw runs as the paper does.

    :param runs: The runs
    :param output: The picture
    """
    from zoo_configs.drawing.curves import draw_curves, mean_curve

    groups: defaultdict[str, defaultdict[str, list[LearningCurve]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        groups[run.env_id][run.baseline].append(run.curve)
    panels = {
        env_id: {name: mean_curve(curves) for name, curves in sorted(lines.items())}
        for env_id, lines in sorted(groups.items())
    }
    draw_curves(panels, output)


def _plot_training(args: argparse.Namespace, output: Path) -> list[Path]:
    from zoo_configs.drawing.training_curves import draw_training
    from zoo_configs.training.training_log import read_training_log

    panels: defaultdict[str, defaultdict[str, list[pd.DataFrame]]] = defaultdict(lambda: defaultdict(list))
    for run in evaluated_runs(args.log_folder, args.env, args.baseline):
        if run.training_log.is_file():
            panels[run.cell.env_id][run.cell.label].append(read_training_log(run.training_log))
    if not panels:
        raise CommandError(f"no run of these in {args.log_folder} has logged its updates")
    draw_training(panels, output)
    return [output]


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo plot", description=DESCRIPTION)
    add = parser.add_argument
    add("--env", nargs="+", help="ids of environments (default: all)")
    add("--baseline", nargs="+", help="baselines (default: all)")
    add(
        *("-f", "--log-folder"),
        type=Path,
        help=f"folder of all runs (default: {LOG_FOLDER}; with --data: none)",
    )
    add(
        "--data",
        type=Path,
        metavar="FILE",
        help="CSV of evaluations: those of the log folder are put into it, and all of it is drawn",
    )
    kinds = ", ".join(FORMATS)
    add("-o", "--output", type=Path, help=f"{kinds} to write (default: {PICTURE} in the log folder)")
    add("--markdown", action="store_true", help="print the table for a Markdown page")
    add(
        "--training",
        action="store_true",
        help="draw the critic's values and the actor's entropy, in the expert's transitions and the agent's "
        f"own (to {TRAINING_PICTURE})",
    )
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix not in FORMATS:
        parser.error(f"--output must end in {kinds}, got {args.output}")
    if args.training and args.data is not None:
        parser.error(
            "--training draws what runs logged, of which --data has nothing: give --log-folder alone"
        )
    if args.data is None and args.log_folder is None:
        args.log_folder = LOG_FOLDER
    return args


def evaluated_runs(
    log_folder: Path, env_ids: Sequence[str] | None = None, baselines: Sequence[str] | None = None
) -> list[Run]:
    """
    Runs that can be drawn.

    :param log_folder: Folder of all runs, or of a benchmark
    :param env_ids: Ids of environments, None for all
    :param baselines: Baselines, None for all
    :return: The runs
    :raises CommandError: if there is none
    """
    from zoo_configs.training.runs import find_runs

    runs = [
        run
        for run in find_runs(log_folder)
        if run.evaluations_file.is_file()
        and _is_wanted(run.cell.env_id, run.cell.baseline, env_ids, baselines)
    ]
    if not runs:
        raise CommandError(f"no evaluated run of these environments and baselines in {log_folder}")
    return runs


def _is_wanted(
    env_id: str, baseline: str | None, env_ids: Sequence[str] | None, baselines: Sequence[str] | None
) -> bool:
    return (env_ids is None or env_id in env_ids) and (baselines is None or baseline in baselines)
