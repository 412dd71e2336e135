"""``bulletarm-zoo train``: resolves a baseline to one YAML and hands it to rl_zoo3."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zoo_configs.environments import known_env_id, register_environments
from zoo_configs.errors import CommandError, unknown_name
from zoo_configs.plan import Plan
from zoo_configs.resolve import Cell, families, merge, resolve

if TYPE_CHECKING:
    from zoo_configs.manager import ZooManager

MAX_SEED = 2**31
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
    _check(plan.cell)
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
    parser = argparse.ArgumentParser(
        "bulletarm-zoo train", description=DESCRIPTION, epilog=EPILOG, add_help=False, allow_abbrev=False
    )
    add = parser.add_argument
    add("-h", "--help", action="store_true", help="show this help and that of rl_zoo3.train")
    add("--baseline", help="row of a benchmark, see bulletarm-zoo list --baselines")
    add("--preset", help="cpu or paper (default: paper with a GPU, else cpu)")
    add("--benchmark", help="benchmark whose parameters the task has, for one that is in several")
    add("--resume", type=Path, metavar="RUN_FOLDER", help="go on from the last checkpoint of an earlier run")
    add("--algo", help="algorithm, for a baseline of the same name or with --conf-file")
    add("--env", help="environment id, see bulletarm-zoo list")
    add("--seed", type=int, help="seed of the run (default: drawn)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("-f", "--log-folder", default="logs", help="folder for run folders (default: logs)")
    add("-conf", "--conf-file", type=Path, help="YAML with hyperparameters by environment id, as in rl_zoo3")
    pairs: dict[str, Any] = {"nargs": "+", "default": [], "metavar": "KEY:VALUE"}
    add("-params", "--hyperparams", help="hyperparameters that win over the preset", **pairs)
    add("--env-kwargs", help="parameters of the environment that win over the preset", **pairs)
    add("--gym-packages", nargs="+", default=[], help="packages that register further environments")
    add(
        "-P",
        "--progress",
        action="store_true",
        default=None,
        help="show a progress bar (default: if a terminal)",
    )
    add("--no-progress", action="store_false", dest="progress", help="show no progress bar")
    return parser


def _print_help() -> None:
    print(build_parser().format_help())
    print("Flags of rl_zoo3.train:\n")
    with _arguments_of_rl_zoo3(["--help"]) as train:
        train.train()


def _new(args: argparse.Namespace, passed_on: list[str]) -> Plan:
    if args.env is None:
        raise CommandError("name an environment with --env, see bulletarm-zoo list")
    env_id = known_env_id(args.env)
    cell = _override(_find_cell(args, env_id), args)
    seed = secrets.randbelow(MAX_SEED) if args.seed is None or args.seed < 0 else args.seed
    where = {"device": args.device, "log_folder": args.log_folder}
    named = {"algo": cell.algo, "env": env_id, "seed": seed, **where}
    arguments = [*_as_flags(cell.flags), *passed_on, *_as_flags(named)]
    return Plan(cell, tuple(arguments))


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
    preset = args.preset or _default_preset(args.device)
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
    overrides = _key_values("-params", args.hyperparams)
    env_kwargs = _key_values("--env-kwargs", args.env_kwargs)
    if env_kwargs:
        overrides["env_kwargs"] = merge(overrides.get("env_kwargs", {}), env_kwargs)
    if cell.baseline is not None and cell.preset is not None:
        return resolve(cell.baseline, cell.preset, cell.env_id, overrides, cell.benchmark)
    return replace(cell, hyperparams=merge(cell.hyperparams, overrides))


def _key_values(flag: str, pairs: list[str]) -> dict[str, Any]:
    """``key:value`` with a Python expression as value, read by rl_zoo3's own action."""
    from rl_zoo3.utils import StoreDict

    namespace = argparse.Namespace(values={})
    try:
        if pairs:
            action: argparse.Action = StoreDict([flag], "values", nargs="+")  # type: ignore[no-untyped-call]
            action(argparse.ArgumentParser(), namespace, pairs)
        values: dict[str, Any] = json.loads(json.dumps(namespace.values))  # what YAML can hold
    except (NameError, SyntaxError, TypeError, ValueError) as error:
        raise CommandError(f"{flag} takes key:value with a Python value (strings quoted): {error}") from error
    return values


def _as_flags(values: dict[str, Any]) -> list[str]:
    return [word for key, value in values.items() for word in (f"--{key.replace('_', '-')}", str(value))]


def _resumed(args: argparse.Namespace, passed_on: list[str]) -> Plan:
    from sb3_extensions.common.checkpoint import latest_checkpoint
    from zoo_configs.runs import CHECKPOINT_FOLDER, load_run

    run = load_run(args.resume)
    checkpoint = latest_checkpoint(args.resume / CHECKPOINT_FOLDER)
    if checkpoint is None:
        raise CommandError(f"{args.resume} has no whole checkpoint to go on from")
    return Plan(run.cell, (*run.arguments, *passed_on), run, checkpoint)


def _check(cell: Cell) -> None:
    from zoo_configs.validation import check_cell, check_env_kwargs, check_expert_data

    check_cell(cell)
    with closing(check_env_kwargs(cell.env_id, cell.hyperparams.get("env_kwargs", {}))) as env:
        check_expert_data(cell.hyperparams, env)


def _run_rl_zoo3(plan: Plan, extra: list[str]) -> ZooManager:
    from zoo_configs.manager import ZooManager

    created: list[ZooManager] = []

    def make_manager(*args: Any, **kwargs: Any) -> ZooManager:
        created.append(ZooManager(plan, *args, **kwargs))
        return created[0]

    with _arguments_of_rl_zoo3([*plan.arguments, *extra]) as train:
        stock, train.ExperimentManager = train.ExperimentManager, make_manager
        try:
            train.train()
        finally:
            train.ExperimentManager = stock
    return created[0]


@contextmanager
def _arguments_of_rl_zoo3(arguments: list[str]) -> Iterator[Any]:
    """rl_zoo3.train reads ``sys.argv`` and its own module's table of algorithms."""
    import rl_zoo3.train

    from zoo_configs.algorithms import register_algorithms

    register_algorithms()
    given, sys.argv = sys.argv, ["bulletarm-zoo train", *arguments]
    try:
        yield rl_zoo3.train
    finally:
        sys.argv = given


def _report(manager: ZooManager) -> None:
    from zoo_configs.curves import draw_run

    run = manager.run
    files = [run.last_model, run.best_model, run.resolved_file]
    if run.evaluations_file.is_file():
        files.append(draw_run(run))
    if manager.interrupted:
        print(f"Stopped early; to go on: bulletarm-zoo train --resume {run.folder}")
    print("\n".join(["Written:", *(f"  {path}" for path in files if path.exists())]))
