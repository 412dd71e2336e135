"""``bulletarm-zoo train``: trains the experiment that the flags name."""

import argparse
import secrets
import shlex
from dataclasses import asdict, replace
from pathlib import Path

from sb3_extensions.common.checkpoint import latest_checkpoint
from zoo_configs.arguments import MAX_SEED
from zoo_configs.drawing.curves import draw_curves, load_curve
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import explained_yaml
from zoo_configs.experiments.flags import find_experiment, packages_of
from zoo_configs.files import check_writable, print_written
from zoo_configs.parsers import parse_train
from zoo_configs.training.options import TrainingOptions, flag, given_options
from zoo_configs.training.runs import Run, load_run
from zoo_configs.training.train import TrainingInterrupted, check_run, resume_run, train_experiment

CHANGEABLE = {"resume", "device", "gym_packages", "progress"}
"""Arguments that are allowed when resuming, with the options but ``trained_agent``."""


def main(args: argparse.Namespace) -> None:
    """Run the command; raise ``KeyboardInterrupt`` after Ctrl-C, when the model is saved."""
    register_environments(args.gym_packages)
    if args.dry_run and not args.resume:
        _print_experiment(args)
        return
    try:
        _report(_resume(args) if args.resume else _begin(args))
    except TrainingInterrupted as stop:
        if latest_checkpoint(stop.run.checkpoint_folder) is None:
            print("Interrupted before the first checkpoint. The run cannot be resumed.")
        else:
            resume = shlex.join(["bulletarm-zoo", "train", "--resume", str(stop.run.folder)])
            print(f"Interrupted. To continue: {resume}")
        _report(stop.run)
        raise


def _print_experiment(args: argparse.Namespace) -> None:
    experiment, given = find_experiment(args), given_options(args)
    options, device = TrainingOptions.of(experiment, given), args.device or "auto"
    run = Run(Path(), experiment, device=device, options=options, gym_packages=packages_of(args))
    check_run(run, args.allow_mismatched_demos)
    check_writable((args.log_folder or Path("logs")) / experiment.algo / "run", "--log-folder")
    print(explained_yaml(experiment, asdict(options), given))


def _begin(args: argparse.Namespace) -> Run:
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
    unset, options = vars(parse_train([])), given_options(args)
    allowed = {*CHANGEABLE, *options} - {"trained_agent"}
    changed = [name for name, value in vars(args).items() if name not in allowed and value != unset.get(name)]
    if changed:
        raise CommandError(f"cannot be changed when resuming: {', '.join(map(flag, changed))}")
    run = load_run(args.resume)
    run = replace(run, options=replace(run.options, **options), device=args.device or run.device)
    return resume_run(run, progress=args.progress)


def _report(run: Run) -> None:
    files = [run.last_model, run.best_model, run.resolved_file]
    if run.evaluations_file.is_file():
        curves = {run.experiment.label: load_curve(run.evaluations_file)}
        draw_curves({run.experiment.env_id: curves}, run.curve_file)
        files.append(run.curve_file)
    print_written(*(path for path in files if path.exists()))
