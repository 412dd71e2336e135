"""Evaluate the best and the last model of runs and keep one row for each run.

python tools/evaluate_runs.py logs/sacfd/BulletArm-CloseLoop*-v0_1 --data docs/data/results.csv

The number of environments is that of the run's own evaluations.
"""

import argparse
import itertools
import shlex
from pathlib import Path

from measurements import Row, keep, number, show
from zoo_configs.agents import agent_of, register_run
from zoo_configs.arguments import Parser, positive_int, seed
from zoo_configs.drawing.curves import load_curve
from zoo_configs.evaluating import EvalOptions, evaluate_agent
from zoo_configs.experiments.config import ExperimentConfig, resolve
from zoo_configs.experiments.families import task_name
from zoo_configs.training.runs import Run, load_run, origin_of

KEY = ("env", "options", "baseline", "preset", "seed")
OVERRIDES = ("--env-kwargs", "-params")
"""Last flags of a training's command line."""


def main() -> None:
    """Run the program."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("run", nargs="+", type=Path, help="run folders")
    add("--data", type=Path, metavar="FILE", help="CSV to add the results to")
    add("-n", "--episodes", type=positive_int, default=100, help="number of episodes (default: 100)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    args = parser.parse_args()
    show([keep(measure(load_run(folder), args), args.data, KEY) for folder in args.run])


def measure(run: Run, args: argparse.Namespace) -> Row:
    """Evaluate both models of a run."""
    register_run(run)
    options = EvalOptions(args.episodes, args.seed, run.options.n_eval_envs)
    rates = {}
    for name in ("best", "last"):
        outcome = evaluate_agent(agent_of(run, name == "best", args.device), options)
        rates[name] = number(outcome.success_rate, 4)
        print(f"{run.folder}, {name}: success_rate={outcome.success_rate:.2f}")
    return row(run, args, rates)


def row(run: Run, args: argparse.Namespace, rates: Row) -> Row:
    """Return the row of a run."""
    origin, hyperparams = origin_of(run), run.experiment.hyperparams
    success = load_curve(run.evaluations_file).success if run.evaluations_file.is_file() else ()
    half = success[len(success) // 2 :]
    return {
        "env": task_name(run.experiment.env_id),
        "options": changes(run.experiment, shlex.split(origin.command)),
        "baseline": run.experiment.label,
        "preset": run.experiment.preset or "",
        "seed": str(run.seed),
        "demonstrations": str(hyperparams.get("expert_episodes", 0)),
        "noise": str(hyperparams.get("expert_noise", "")),
        "dagger": "yes" if hyperparams.get("dagger") else "",
        "updates": str(hyperparams.get("pretrain_steps", 0)),
        "steps": str(run.n_timesteps),
        **rates,
        "episodes": str(args.episodes),
        "least": number(min(half, default=float("nan")), 4),
        "greatest": number(max(half, default=float("nan")), 4),
        "minutes": number(float("nan") if origin.minutes is None else origin.minutes, 1),
        **{name: getattr(origin, name) for name in ("machine", "date", "commit", "command")},
    }


def changes(experiment: ExperimentConfig, command: list[str]) -> str:
    """Return the flags by which an experiment differs from its baseline and preset on its task."""
    words = [*itertools.dropwhile(lambda word: word not in OVERRIDES, command)]
    if "--benchmark" in command:
        usual = resolve(str(experiment.baseline), str(experiment.preset), experiment.env_id).benchmark
        words = ["--benchmark", str(experiment.benchmark), *words] if experiment.benchmark != usual else words
    return " ".join(words)


if __name__ == "__main__":
    main()
