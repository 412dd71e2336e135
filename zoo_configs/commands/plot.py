"""``bulletarm-zoo plot``: draws the learning curves of many runs into one picture."""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable

if TYPE_CHECKING:
    import pandas as pd

    from zoo_configs.drawing.curves import LearningCurve
    from zoo_configs.training.runs import Run

DESCRIPTION = """Draw the evaluations of all runs in a log folder, as the paper does: a panel an environment,
a line a baseline, the mean over its runs (seeds) shaded by their standard error. Prints the last and the
best point of each line."""
PICTURE, TRAINING_PICTURE = "learning_curves.png", "training_curves.png"
FORMATS = (".png", ".pdf", ".svg")


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no run to draw
    """
    args = _parse(argv)
    runs = _chosen(args.log_folder, args.env, args.baseline)
    output = args.output or args.log_folder / (TRAINING_PICTURE if args.training else PICTURE)
    check_writable(output, "--output")
    (_plot_training if args.training else _plot_success)(runs, args, output)
    print(f"Written:\n  {output}")


def _plot_success(runs: list[Run], args: argparse.Namespace, output: Path) -> None:
    from zoo_configs.drawing.curves import draw_curves, load_curve

    groups: defaultdict[str, defaultdict[str, list[LearningCurve]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        groups[run.cell.env_id][run.cell.label].append(load_curve(run.evaluations_file))
    panels = {env_id: _means(env_id, lines) for env_id, lines in sorted(groups.items())}
    panels = {env_id: lines for env_id, lines in panels.items() if lines}
    if not panels:
        raise CommandError("there is nothing to draw")
    rows = [
        [env_id, name, str(len(groups[env_id][name])), *_summary(curve)]
        for env_id, lines in panels.items()
        for name, curve in lines.items()
    ]
    print_table(["environment", "baseline", "runs", "steps", "last", "best"], rows, args.markdown)
    draw_curves(panels, output)


def _means(env_id: str, lines: Mapping[str, Sequence[LearningCurve]]) -> dict[str, LearningCurve]:
    """The lines of a panel; one whose runs cannot be averaged is told and left out."""
    from zoo_configs.drawing.curves import mean_curve

    means = {}
    for name, curves in sorted(lines.items()):
        try:
            means[name] = mean_curve(curves)
        except ValueError as error:
            print(f"left out: {name} on {env_id}: {error}", file=sys.stderr)
    return means


def _plot_training(runs: list[Run], args: argparse.Namespace, output: Path) -> None:
    from zoo_configs.drawing.training_curves import draw_training
    from zoo_configs.training.training_log import read_training_log

    panels: defaultdict[str, defaultdict[str, list[pd.DataFrame]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        if run.training_log.is_file():
            panels[run.cell.env_id][run.cell.label].append(read_training_log(run.training_log))
    if not panels:
        raise CommandError(f"no run of these in {args.log_folder} has logged its updates")
    draw_training(panels, output)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo plot", description=DESCRIPTION)
    add = parser.add_argument
    add("--env", nargs="+", help="ids of environments (default: all)")
    add("--baseline", nargs="+", help="baselines (default: all)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
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
    return args


def _chosen(log_folder: Path, env_ids: list[str] | None, baselines: list[str] | None) -> list[Run]:
    from zoo_configs.training.runs import find_runs

    runs = [
        run
        for run in find_runs(log_folder)
        if (env_ids is None or run.cell.env_id in env_ids)
        and (baselines is None or run.cell.baseline in baselines)
        and run.evaluations_file.is_file()
    ]
    if not runs:
        raise CommandError(f"no evaluated run of these environments and baselines in {log_folder}")
    return runs


def _summary(curve: LearningCurve) -> list[str]:
    """Steps, last and best point of a curve."""
    best = int(curve.success.argmax())
    points = [f"{curve.success[n]:.2f} ± {curve.error[n]:.2f}" for n in (-1, best)]
    return [str(curve.timesteps[-1]), *points]
