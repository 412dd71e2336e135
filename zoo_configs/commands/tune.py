"""``bulletarm-zoo tune``: searches hyperparameters with Optuna, in one or several processes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_packages, add_progress, positive_int, seed, whole_number
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.experiments.families import task_name
from zoo_configs.experiments.flags import add_experiment_flags, find_experiment, packages_of
from zoo_configs.files import print_written
from zoo_configs.training.options import TrainingOptions, add_options, given_options

if TYPE_CHECKING:
    from zoo_configs.tuning.study import Search

DESCRIPTION = """Search hyperparameters. The experiment is named as for train, and its values are the first
trial. Processes with the same command, on machines that share the log folder, work on one study. A trial
whose process dies is continued by another process. The same command continues a study."""
EPILOG = "bulletarm-zoo tune --baseline sacfd --env BulletArm/CloseLoopBlockReaching-v0 --n-trials 20"


def main(argv: Sequence[str]) -> None:
    """Run the command."""
    args = build_parser().parse_args(argv)
    register_environments(packages_of(args))
    search = _search(args)

    import matplotlib as mpl
    import optuna

    from zoo_configs.tuning.study import BEST_FILE, check_complete, open_study, summary, work, write_report

    mpl.use("Agg")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = open_study(search)
    try:
        work(search, study, args.progress)
    finally:
        print(f"study {search.name}: {summary(study)}")
        files = write_report(search, study)
        print_written(*files) if files else print("no trial is complete")
    check_complete(search, study)
    run = search.run
    named = f"--algo {run.experiment.algo} --env {run.experiment.env_id} --seed {run.seed + 1}"
    print(f"To train with the best values: bulletarm-zoo train {named} --conf-file {run.folder / BEST_FILE}")
    print(f"To view the study: optuna-dashboard {search.storage_name}")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = Parser("bulletarm-zoo tune", description=DESCRIPTION, epilog=EPILOG, allow_abbrev=False)
    add_experiment_flags(parser)
    add = parser.add_argument
    add("--seed", type=seed, default=0, help="seed of all trials and the sampler (default: 0)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of studies/ (default: logs)")
    add("--space", type=Path, help="YAML with the search space (default: that of the algorithm)")
    add("--n-trials", type=positive_int, default=100, help="trials of all processes (default: 100)")
    add("--n-startup-trials", type=whole_number(0), default=10, help="trials at random (default: 10)")
    add("--n-evaluations", type=positive_int, default=8, help="evaluations of a trial (default: 8)")
    add("--pruner", choices=("median", "none"), default="median", help="default: median")
    add("--storage", help="URL of a database, or a journal file (default: a journal in the study's folder)")
    add("--study-name", help="default: the baseline and the task")
    add_packages(parser)
    add_progress(parser)
    add_options(parser)
    return parser


def _search(args: argparse.Namespace) -> Search:
    from zoo_configs.experiments.validation import check_experiment
    from zoo_configs.training.runs import Run
    from zoo_configs.tuning.space import load_space
    from zoo_configs.tuning.study import Search

    experiment = find_experiment(args)
    check_experiment(experiment)
    name = args.study_name or f"{experiment.label}_{task_name(experiment.env_id)}"
    given = {"verbose": 0, "n_timesteps": int(experiment.hyperparams["n_timesteps"]), **given_options(args)}
    if "eval_freq" in given:
        raise CommandError("--eval-freq follows from the time steps of a trial. Use --n-evaluations.")
    given["eval_freq"] = max(given["n_timesteps"] // args.n_evaluations, 1)
    given.setdefault("save_freq", given["eval_freq"])
    folder, options = args.log_folder / "studies" / name, TrainingOptions.of(experiment, given)
    run = Run(folder, experiment, args.seed, args.device, options, packages_of(args))
    space = load_space(experiment, args.hyperparams, args.space)
    return Search(name, run, space, args.n_trials, args.pruner, args.n_startup_trials, args.storage)
