"""``bulletarm-zoo tune``: searches hyperparameters with Optuna, in one or several processes."""

import argparse
import shlex

import matplotlib as mpl
import optuna

from zoo_configs.environments import register_environments
from zoo_configs.experiments.families import task_name
from zoo_configs.experiments.flags import find_experiment, packages_of
from zoo_configs.files import print_written
from zoo_configs.training.options import TrainingOptions, given_options
from zoo_configs.training.runs import Run
from zoo_configs.training.train import check_run
from zoo_configs.tuning.space import load_space
from zoo_configs.tuning.study import (
    BEST_FILE,
    Search,
    check_complete,
    open_study,
    summary,
    work,
    write_report,
)


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    register_environments(packages_of(args))
    search = _search(args)
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
    words = ["bulletarm-zoo", "train", "--algo", run.experiment.algo, "--env", run.experiment.env_id]
    words += ["--seed", str(run.seed + 1), "--conf-file", str(run.folder / BEST_FILE)]
    words += ["--gym-packages", ",".join(run.gym_packages)] if run.gym_packages else []
    print(f"To train with the best values: {shlex.join(words)}")
    print(f"To view the study: {shlex.join(['optuna-dashboard', search.storage_name])}")


def _search(args: argparse.Namespace) -> Search:
    experiment = find_experiment(args)
    name = args.study_name or f"{experiment.label}_{task_name(experiment.env_id)}"
    given = {"verbose": 0, "n_timesteps": int(experiment.hyperparams["n_timesteps"]), **given_options(args)}
    given["eval_freq"] = max(given["n_timesteps"] // args.n_evaluations, 1)
    given.setdefault("save_freq", given["eval_freq"])
    folder, options = args.log_folder / "studies" / name, TrainingOptions.of(experiment, given)
    run = Run(folder, experiment, args.seed, args.device, options, packages_of(args))
    check_run(run, allow_mismatched_demos=False)
    space = load_space(experiment, args.hyperparams, args.space)
    return Search(name, run, space, args.n_trials, args.pruner, args.n_startup_trials, args.storage)
