"""``bulletarm-zoo train``: trains the experiment that the flags name."""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import MAX_SEED, Parser, add_packages, add_progress, whole_number
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig
from zoo_configs.experiments.flags import add_experiment_flags, find_experiment, packages_of
from zoo_configs.files import print_written
from zoo_configs.training.options import TrainingOptions, add_options, given_options

if TYPE_CHECKING:
    from zoo_configs.training.runs import Run

FIXED = (
    *("baseline", "preset", "benchmark", "algo", "env", "env_kwargs", "hyperparams", "conf_file", "seed"),
    *("log_folder", "allow_mismatched_demos", "trained_agent", "dry_run"),
)
"""Arguments that a resumed run cannot change."""
DESCRIPTION = """Train an agent. --baseline, --preset and --env name an experiment, whose hyperparameters are
written to the run folder. The options of the training replace the preset's."""
EPILOG = "bulletarm-zoo train --baseline equi_sacfd --env BulletArm/CloseLoopBlockPicking-v0 --preset quick"


def main(argv: Sequence[str]) -> None:
    """Run the command; raise ``KeyboardInterrupt`` after Ctrl-C, when the model is saved."""
    args = build_parser().parse_args(argv)
    register_environments(args.gym_packages)
    if args.dry_run and not args.resume:
        _print_experiment(find_experiment(args), args)
        return
    from zoo_configs.training.train import TrainingInterrupted

    try:
        _report(_resume(args) if args.resume else _begin(args))
    except TrainingInterrupted as stop:
        print(f"Interrupted. To continue: bulletarm-zoo train --resume {stop.run.folder}")
        _report(stop.run)
        raise


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = Parser("bulletarm-zoo train", description=DESCRIPTION, epilog=EPILOG, allow_abbrev=False)
    add_experiment_flags(parser)
    add = parser.add_argument
    add("--resume", type=Path, metavar="RUN_FOLDER", help="resume a run from its last checkpoint")
    add("--dry-run", action="store_true", help="print the configuration and the source of each value")
    add("--seed", type=whole_number(-1, MAX_SEED), help="seed of the run (default, and -1: sampled)")
    add("--device", help="PyTorch device (default: auto; with --resume that of the run)")
    add("-f", "--log-folder", type=Path, help="folder for run folders (default: logs)")
    add("--allow-mismatched-demos", action="store_true", help="accept expert_data from another environment")
    add_packages(parser)
    add_progress(parser)
    add_options(parser)
    return parser


def _print_experiment(experiment: ExperimentConfig, args: argparse.Namespace) -> None:
    from zoo_configs.experiments.config import explained_yaml
    from zoo_configs.experiments.validation import check_experiment

    check_experiment(experiment)
    given = given_options(args)
    print(explained_yaml(experiment, TrainingOptions.of(experiment, given).plain(), given))


def _begin(args: argparse.Namespace) -> Run:
    from zoo_configs.training.train import train_experiment

    experiment = find_experiment(args)
    seed = secrets.randbelow(MAX_SEED + 1) if args.seed in (None, -1) else args.seed
    is_default = experiment.baseline != args.baseline
    default = f", baseline {experiment.baseline} of --algo {args.algo}" if is_default else ""
    print(f"{experiment.env_id}, seed {seed}{default}")
    return train_experiment(
        experiment,
        seed,
        args.device or "auto",
        args.log_folder or Path("logs"),
        options=TrainingOptions.of(experiment, given_options(args)),
        gym_packages=packages_of(args),
        allow_mismatched_demos=args.allow_mismatched_demos,
        progress=args.progress,
    )


def _resume(args: argparse.Namespace) -> Run:
    from zoo_configs.training.runs import load_run
    from zoo_configs.training.train import resume_run

    unset = build_parser().parse_args([])
    changed = [name for name in FIXED if getattr(args, name, None) != getattr(unset, name, None)]
    if changed:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
        raise CommandError(f"cannot be changed when resuming: {flags}")
    run = load_run(args.resume)
    options = replace(run.options, **given_options(args))
    return resume_run(replace(run, options=options, device=args.device or run.device), progress=args.progress)


def _report(run: Run) -> None:
    from zoo_configs.drawing.curves import draw_run

    files = [run.last_model, run.best_model, run.resolved_file]
    if run.evaluations_file.is_file():
        files.append(draw_run(run))
    print_written(*(path for path in files if path.exists()))
