"""``bulletarm-zoo results``: evaluates runs and keeps a table of what they reached."""

from __future__ import annotations

import argparse
import itertools
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_packages, add_progress, device, positive_int, seed
from zoo_configs.measuring.data_files import RESULTS, DataFile, Record, number

if TYPE_CHECKING:
    from zoo_configs.cells.cell import Cell
    from zoo_configs.training.runs import Run

DESCRIPTION = """Evaluate the best and the last model of runs on scenes unseen in training, and put a row for
each run into a file of measurements: what it reached, how it was trained, machine, date, commit and command.
Agents act in as many environments as in the evaluations of their training. A row of the same training is
replaced. `report --docs` shows them on pages."""
DATA = Path("results.csv")
OVERRIDES = ("--env-kwargs", "-params")  # the last words of a training's command
DIGITS = 4


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if a run has no model, or the file cannot be read or written
    """
    args = _parse(argv)
    from zoo_configs.environments import register_environments
    from zoo_configs.training.runs import load_run

    register_environments(args.gym_packages)
    data = DataFile(args.data, RESULTS)
    data.check("--data")
    for run in [load_run(folder) for folder in args.run]:
        data.add(_measure(run, args))
    print(f"Written:\n  {args.data}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo results", description=DESCRIPTION)
    add = parser.add_argument
    add("run", nargs="+", type=Path, metavar="RUN_FOLDER", help="run folders")
    add("--data", type=Path, metavar="FILE", default=DATA, help=f"CSV of the rows (default: {DATA})")
    add("-n", "--episodes", type=positive_int, default=100, help="how many episodes (default: 100)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--commit", default="", help="commit that the runs were trained with (default: what they say)")
    add("--device", type=device, default="auto", help="PyTorch device (default: auto)")
    add_packages(parser)
    add_progress(parser)
    args = parser.parse_args(argv)
    args.render, args.stochastic, args.env_kwargs = False, False, {}  # as evaluations take them
    return args


def _measure(run: Run, args: argparse.Namespace) -> Record:
    from zoo_configs.agents import agent_of
    from zoo_configs.environments import known_env_id, register_environments
    from zoo_configs.publishing.packing import check_publishable, evaluate_agent

    register_environments(run.gym_packages)
    known_env_id(run.cell.env_id)
    check_publishable(run)
    # Where an environment keeps its scene, as Object Grasping, what is reached depends on how many there are
    args.n_envs = run.options.n_eval_envs
    reached = {}
    for name in ("best", "last"):
        agent = agent_of(run, name == "best", args.device)
        outcome = evaluate_agent(agent, args)
        how = f"success_rate={outcome.rate:.2f} episodes={outcome.episodes}"
        print(f"{agent.label} on {agent.env_id}, {name}: {how}")
        reached[name] = number(outcome.rate, DIGITS)
    return _row(run, args, **reached)


def _row(run: Run, args: argparse.Namespace, best: str, last: str) -> Record:
    from zoo_configs.cells.rules import task_name
    from zoo_configs.drawing.curves import load_curve
    from zoo_configs.training.origin import origin_of

    origin, hyperparams, options = origin_of(run, args.commit), run.cell.hyperparams, run.options
    success = load_curve(run.evaluations_file).success if run.evaluations_file.is_file() else ()
    half = success[len(success) // 2 :]
    return {
        "env": task_name(run.cell.env_id),
        "options": _options(run.cell, shlex.split(origin.command)),
        "baseline": run.cell.label,
        "preset": run.cell.preset or "",
        "seed": str(run.seed),
        "earlier": "",
        "demonstrations": str(hyperparams.get("expert_episodes", 0)),
        "noise": str(hyperparams.get("expert_noise", "")),
        "dagger": "yes" if hyperparams.get("dagger") else "",
        "updates": str(hyperparams.get("pretrain_steps", 0)),
        "steps": str(int(options.n_timesteps if options.n_timesteps > 0 else hyperparams["n_timesteps"])),
        "best": best,
        "last": last,
        "episodes": str(args.episodes),
        "least": number(min(half, default=math.nan), DIGITS),
        "greatest": number(max(half, default=math.nan), DIGITS),
        "minutes": number(math.nan if origin.minutes is None else origin.minutes, 1),
        "machine": origin.machine,
        "date": origin.date,
        "commit": origin.commit,
        "command": origin.command,
    }


def _options(cell: Cell, command: Sequence[str]) -> str:
    """What sets a training apart from the others of its baseline and preset on its task, of its command."""
    words = [*itertools.dropwhile(lambda word: word not in OVERRIDES, command)]
    # A run of another version, whose baseline may be gone, is repeated from its file: none is named.
    if cell.benchmark and "--benchmark" in command and cell.benchmark != _first_benchmark(cell):
        words = ["--benchmark", cell.benchmark, *words]
    return " ".join(words)


def _first_benchmark(cell: Cell) -> str | None:
    """The benchmark that a training is of where its command names none."""
    from zoo_configs.cells.cell import resolve

    if cell.baseline is None or cell.preset is None:
        return None
    return resolve(cell.baseline, cell.preset, cell.env_id).benchmark
