"""``bulletarm-zoo train``: resolves a baseline to one YAML and hands it to rl_zoo3."""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from zoo_configs.environments import (
    check_alike,
    known_env_id,
    make_env,
    package_of,
    register_environments,
    try_env,
)
from zoo_configs.errors import CommandError, unknown_name
from zoo_configs.training.plan import Plan
from zoo_configs.training.zoo_flags import check_flags, given_flags, parser_of_rl_zoo3, train_module

if TYPE_CHECKING:
    from zoo_configs.training.manager import ZooManager
    from zoo_configs.training.runs import Run

PROG = "bulletarm-zoo train"
# What a resumed run was begun with and keeps: of these flags, and of those of rl_zoo3.train.
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
hyperparameters are written to the run folder as one YAML. All flags of rl_zoo3.train are taken as well and
win over the preset."""
EPILOG = "bulletarm-zoo train --baseline equi_sacfd --env BulletArm/CloseLoopBlockPicking-v0 --preset quick"


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: for arguments that cannot be followed
    :raises KeyboardInterrupt: after Ctrl-C, once the model is saved
    """
    args, passed_on = build_parser().parse_known_args(argv)
    if args.help:
        _print_help()
        return
    register_environments(args.gym_packages)
    plan = _resumed(args, passed_on) if args.resume else _new(args, passed_on)
    _check(plan, args.any_demonstrations)
    progress = args.progress if args.progress is not None else sys.stderr.isatty()
    manager = _run_rl_zoo3(plan, ["--progress"] if progress else [])
    _report(manager)
    if manager.interrupted:
        raise KeyboardInterrupt


def build_parser() -> argparse.ArgumentParser:
    """
    Parser of the command's own flags, and of those of rl_zoo3 that it has to know.

    :return: The parser; what it does not know is for ``rl_zoo3.train``
    """
    parser = Parser(PROG, description=DESCRIPTION, epilog=EPILOG, add_help=False, allow_abbrev=False)
    add = parser.add_argument
    add("-h", "--help", action="store_true", help="show this help and that of rl_zoo3.train")
    add("--baseline", help="row of a benchmark, see bulletarm-zoo list --baselines")
    add("--preset", help="cpu or paper (default: paper with a GPU, else cpu)")
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
    return parser


def _print_help() -> None:
    print(build_parser().format_help())
    print("Flags of rl_zoo3.train:\n")
    parser_of_rl_zoo3(PROG).print_help()


def _new(args: argparse.Namespace, passed_on: list[str]) -> Plan:
    if args.env is None:
        raise CommandError("name an environment with --env, see bulletarm-zoo list")
    env_id = known_env_id(args.env)
    cell = _override(_find_cell(args, env_id), args)
    seed = secrets.randbelow(MAX_SEED + 1) if args.seed in (None, -1) else args.seed
    where = {"device": args.device or "auto", "log_folder": args.log_folder or "logs"}
    named = {"algo": cell.algo, "env": env_id, "seed": seed, **where}
    arguments = [*_as_flags(cell.flags), *passed_on, *_as_flags(named)]
    packages = dict.fromkeys([*args.gym_packages, *package_of(args.env)])
    return Plan(cell, tuple(arguments), gym_packages=tuple(packages))


def _find_cell(args: argparse.Namespace, env_id: str) -> Cell:
    """Hyperparameters from ``--conf-file``, else from the baseline, else those that rl_zoo3 ships."""
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


def _as_flags(values: dict[str, Any]) -> list[str]:
    return [word for key, value in values.items() for word in (f"--{key.replace('_', '-')}", str(value))]


def _resumed(args: argparse.Namespace, passed_on: list[str]) -> Plan:
    from zoo_configs.training.runs import load_run

    given, default = {**vars(args), **given_flags(passed_on)}, build_parser().get_default
    if others := [flag for flag, name in FIXED.items() if given.get(name) != default(name)]:
        raise CommandError(f"--resume goes on with what the run has: leave out {', '.join(others)}")
    run = load_run(args.resume)
    register_environments(run.gym_packages)
    known_env_id(run.cell.env_id)
    device = [] if args.device is None else ["--device", args.device]
    return Plan(run.cell, (*run.arguments, *passed_on, *device), run, _last_checkpoint(run))


def _last_checkpoint(run: Run) -> Path:
    """The newest checkpoint that is whole."""
    from sb3_extensions.common.checkpoint import CheckpointError, latest_whole_checkpoint

    try:
        checkpoint, damaged = latest_whole_checkpoint(run.checkpoint_folder)
    except CheckpointError as error:
        raise CommandError(str(error)) from error
    for damage in damaged:
        print(f"{damage}; going on from {checkpoint}", file=sys.stderr)
    return checkpoint


def _check(plan: Plan, any_demonstrations: bool) -> None:
    from zoo_configs.cells.validation import check_cell, check_expert_data

    check_cell(plan.cell)
    given, env_id = check_flags(plan.arguments), plan.cell.env_id
    env_kwargs = plan.cell.hyperparams.get("env_kwargs", {})
    try_env(env_id, env_kwargs)
    with closing(make_env(env_id, env_kwargs)) as env:
        if "eval_env_kwargs" in given:
            with closing(make_env(env_id, {**env_kwargs, **given["eval_env_kwargs"]})) as eval_env:
                check_alike(eval_env, env, "--eval-env-kwargs")
        if plan.run is None:  # a resumed one has them in its replay buffer
            check_expert_data(plan.cell, env, any_demonstrations)


def _run_rl_zoo3(plan: Plan, extra: list[str]) -> ZooManager:
    from zoo_configs.training.manager import ZooManager

    created: list[ZooManager] = []

    def make_manager(*args: Any, **kwargs: Any) -> ZooManager:
        created.append(ZooManager(plan, *args, **kwargs))
        return created[0]

    with train_module() as train, _arguments([*plan.arguments, *extra]):
        train.ExperimentManager = make_manager
        try:
            train.train()
        except BaseException:
            if created and plan.run is None:
                created[0].discard_if_fruitless()
            raise
    return created[0]


@contextmanager
def _arguments(arguments: list[str]) -> Iterator[None]:
    """rl_zoo3.train reads ``sys.argv``."""
    given, sys.argv = sys.argv, [PROG, *arguments]
    try:
        yield
    finally:
        sys.argv = given


def _report(manager: ZooManager) -> None:
    from zoo_configs.drawing.curves import draw_run

    run = manager.run
    files = [run.last_model, run.best_model, run.resolved_file]
    if run.evaluations_file.is_file():
        files.append(draw_run(run))
    if manager.interrupted:
        print(f"Stopped early; to go on: bulletarm-zoo train --resume {run.folder}")
    print("\n".join(["Written:", *(f"  {path}" for path in files if path.exists())]))
