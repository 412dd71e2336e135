"""``bulletarm-zoo train``: finds the cell that the flags name, and trains it."""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import (
    MAX_SEED,
    Parser,
    add_env_kwargs,
    add_key_values,
    add_packages,
    add_progress,
    whole_number,
)
from zoo_configs.cells.cell import Cell, merge, resolve
from zoo_configs.cells.ranges import check_values
from zoo_configs.cells.rules import families
from zoo_configs.environments import known_env_id, package_of, register_environments
from zoo_configs.errors import CommandError, unknown_name
from zoo_configs.training.options import TrainingOptions, add_options, given_options

if TYPE_CHECKING:
    from zoo_configs.training.runs import Run

PROG = "bulletarm-zoo train"
# What a resumed run was begun with and keeps.
FIXED = {
    "--baseline": "baseline",
    "--preset": "preset",
    "--benchmark": "benchmark",
    "--algo": "algo",
    "--env": "env",
    "--env-kwargs": "env_kwargs",
    "-params": "hyperparams",
    "--conf-file": "conf_file",
    "--seed": "seed",
    "--log-folder": "log_folder",
    "--any-demonstrations": "any_demonstrations",
    "--trained-agent": "trained_agent",
}
DESCRIPTION = """Train an agent. --baseline, --preset and --env name one cell of a benchmark; its
hyperparameters are written to the run folder as one YAML. The flags of rl_zoo3.train win over the preset."""
EPILOG = "bulletarm-zoo train --baseline equi_sacfd --env BulletArm/CloseLoopBlockPicking-v0 --preset quick"


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: for arguments that cannot be followed
    :raises KeyboardInterrupt: after Ctrl-C, once the model is saved
    """
    args = build_parser().parse_args(argv)
    register_environments(args.gym_packages)
    progress = args.progress if args.progress is not None else sys.stderr.isatty()
    from zoo_configs.training.cell import TrainingInterrupted

    try:
        _report(_resume(args, progress) if args.resume else _begin(args, progress))
    except TrainingInterrupted as stop:
        print(f"Stopped early; to go on: bulletarm-zoo train --resume {stop.run.folder}")
        _report(stop.run)
        raise


def build_parser() -> argparse.ArgumentParser:
    """
    Parser of the command's own flags and of those of rl_zoo3.

    :return: The parser
    """
    parser = Parser(PROG, description=DESCRIPTION, epilog=EPILOG, allow_abbrev=False)
    add = parser.add_argument
    add("--baseline", help="row of a benchmark, see bulletarm-zoo list --baselines")
    add("--preset", help="cpu, quick or paper (default: paper with a GPU, else cpu)")
    add("--benchmark", help="benchmark whose parameters the task has, for one that is in several")
    add("--resume", type=Path, metavar="RUN_FOLDER", help="go on from the last checkpoint of an earlier run")
    add("--algo", help="algorithm, for a baseline of the same name or with --conf-file")
    add("--env", help="environment id, see bulletarm-zoo list")
    add("--seed", type=whole_number(-1, MAX_SEED), help="seed of the run (default, and -1: drawn)")
    add("--device", help="PyTorch device (default: auto; that of the run with --resume)")
    add("-f", "--log-folder", type=Path, help="folder for run folders (default: logs)")
    add("-conf", "--conf-file", type=Path, help="YAML with hyperparameters by environment id, as in rl_zoo3")
    add_key_values(parser, "-params", "--hyperparams", help="hyperparameters that win over the preset")
    add_env_kwargs(parser)
    add("--any-demonstrations", action="store_true", help="take an expert_data file of other parameters, too")
    add_packages(parser)
    add_progress(parser)
    add_options(parser)
    return parser


def _begin(args: argparse.Namespace, progress: bool) -> Run:
    from zoo_configs.training.cell import train_cell

    if args.env is None:
        raise CommandError("name an environment with --env, see bulletarm-zoo list")
    cell = find_cell(args, known_env_id(args.env))
    seed = secrets.randbelow(MAX_SEED + 1) if args.seed in (None, -1) else args.seed
    print(f"{cell.env_id}, seed {seed}")
    return train_cell(
        cell,
        seed,
        args.device or "auto",
        args.log_folder or Path("logs"),
        options=TrainingOptions.of(cell, given_options(args)),
        gym_packages=tuple(dict.fromkeys([*args.gym_packages, *package_of(args.env)])),
        any_demonstrations=args.any_demonstrations,
        progress=progress,
    )


def _resume(args: argparse.Namespace, progress: bool) -> Run:
    from zoo_configs.training.cell import resume_run
    from zoo_configs.training.runs import load_run

    unset = build_parser().parse_args([])
    changed = {name for name in FIXED.values() if getattr(args, name, None) != getattr(unset, name, None)}
    if others := [flag for flag, name in FIXED.items() if name in changed]:
        raise CommandError(f"--resume goes on with what the run has: leave out {', '.join(others)}")
    run = load_run(args.resume)
    options = replace(run.options, **given_options(args))
    return resume_run(replace(run, options=options, device=args.device or run.device), progress=progress)


def find_cell(args: argparse.Namespace, env_id: str) -> Cell:
    """
    The cell that the flags name: from ``--conf-file``, else from the baseline, else what rl_zoo3 ships.

    :param args: The parsed flags
    :param env_id: Id of the environment
    :return: The cell, with the hyperparameters of the command line in it
    :raises CommandError: if there is none
    """
    return _override(_find_cell(args, env_id), args)


def _find_cell(args: argparse.Namespace, env_id: str) -> Cell:
    if args.conf_file is not None:
        if args.baseline is not None:
            raise CommandError("give --baseline or --conf-file, not both")
        return _cell_from_file(args.conf_file, _required_algo(args), env_id)
    baseline = args.baseline
    if baseline is None and _has_baseline(args.algo, env_id):
        baseline = args.algo
    if baseline is None:
        return _cell_from_rl_zoo3(_required_algo(args), env_id)
    preset = _default_preset(args.device or "auto") if args.preset is None else args.preset
    cell = resolve(baseline, preset, env_id, benchmark=args.benchmark)
    if args.algo not in (None, baseline, cell.algo):
        raise CommandError(f"baseline {baseline!r} is trained by --algo {cell.algo}, not {args.algo}")
    return cell


def _required_algo(args: argparse.Namespace) -> str:
    if args.algo is None:
        raise CommandError("name a baseline with --baseline, or an algorithm with --algo")
    if args.preset is not None:
        raise CommandError("--preset belongs to --baseline")
    if args.benchmark is not None:
        raise CommandError("--benchmark belongs to --baseline")
    return str(args.algo)


def _has_baseline(name: str | None, env_id: str) -> bool:
    return any(family.serves(env_id) and name in family.baselines for family in families())


def _default_preset(device: str) -> str:
    import torch

    return "paper" if device != "cpu" and torch.cuda.is_available() else "cpu"


def _cell_from_rl_zoo3(algo: str, env_id: str) -> Cell:
    import rl_zoo3

    from zoo_configs.algorithms import register_algorithms

    algorithms = register_algorithms()
    if algo not in algorithms:
        raise unknown_name("algorithm", algo, algorithms)
    path = Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
    if not path.is_file():
        raise CommandError(f"no hyperparameters for {algo} on {env_id}: give --baseline or --conf-file")
    return _cell_from_file(path, algo, env_id)


def _cell_from_file(path: Path, algo: str, env_id: str) -> Cell:
    import yaml

    if path.suffix not in (".yml", ".yaml") or not path.is_file():
        raise CommandError(f"--conf-file takes a YAML file, got {path}")
    try:
        sections = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise CommandError(f"{path} is not valid YAML: {error}") from error
    section = sections.get(env_id, sections.get("default")) if isinstance(sections, dict) else None
    if not isinstance(section, dict):
        raise CommandError(f"{path} has neither a section {env_id!r} nor 'default'")
    return Cell(algo, env_id, section)


def _override(cell: Cell, args: argparse.Namespace) -> Cell:
    check_values(args.hyperparams)
    overrides = dict(args.hyperparams)
    if args.env_kwargs:
        overrides["env_kwargs"] = merge(overrides.get("env_kwargs", {}), args.env_kwargs)
    if cell.baseline is not None and cell.preset is not None:
        return resolve(cell.baseline, cell.preset, cell.env_id, overrides, cell.benchmark)
    return replace(cell, hyperparams=merge(cell.hyperparams, overrides))


def _report(run: Run) -> None:
    from zoo_configs.drawing.curves import draw_run

    files = [run.last_model, run.best_model, run.resolved_file]
    if run.evaluations_file.is_file():
        files.append(draw_run(run))
    print("\n".join(["Written:", *(f"  {path}" for path in files if path.exists())]))
