"""The flags that name a cell, and the cell that they name."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from zoo_configs.arguments import add_env_kwargs, add_key_values
from zoo_configs.cells.benchmarks import serves
from zoo_configs.cells.cell import Cell, merge, resolve
from zoo_configs.cells.ranges import check_values
from zoo_configs.cells.rules import Family, families
from zoo_configs.errors import CommandError, unknown_name
from zoo_configs.yaml_files import read_yaml

EXTRACTOR = "sb3_extensions.encoders.extractors.CnnExtractor"
"""Features extractor of stock algorithms for images."""
PRESETS = "cpu, paper, or in close loop quick"
DEFAULT_TIMESTEPS = 1_000_000
"""Length of a training without baseline or file, as in rl_zoo3."""


def add_cell_flags(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags that name a cell.

    :param parser: Parser of a command
    """
    add = parser.add_argument
    add("--baseline", help="row of a benchmark, see bulletarm-zoo list --baselines")
    add("--preset", help=f"{PRESETS} (default: paper with a GPU, else cpu)")
    add("--benchmark", help="benchmark whose parameters the task has, for one that is in several")
    add("--algo", help="algorithm: its baseline, or with --conf-file")
    add("--env", help="environment id, see bulletarm-zoo list")
    add("-conf", "--conf-file", type=Path, help="YAML with hyperparameters by environment id, as in rl_zoo3")
    add_key_values(parser, "-params", "--hyperparams", help="hyperparameters that win over the preset")
    add_env_kwargs(parser)


def find_cell(args: argparse.Namespace, env_id: str) -> Cell:
    """
    The cell that the flags name: from ``--conf-file``, else from the baseline, else the algorithm's defaults.

    :param args: The parsed flags
    :param env_id: Id of the environment
    :return: The cell, with the hyperparameters of the command line in it
    :raises CommandError: if there is none
    """
    cell = _override(_find_cell(args, env_id), args)
    is_default = cell.baseline is None and args.conf_file is None and "policy" not in args.hyperparams
    if is_default and any(family.serves(env_id) for family in families()):
        return _with_policy_for_dicts(cell)
    return cell


def _find_cell(args: argparse.Namespace, env_id: str) -> Cell:
    if args.conf_file is not None:
        if args.baseline is not None:
            raise CommandError("give --baseline or --conf-file, not both")
        return _cell_from_file(args.conf_file, _required_algo(args), env_id)
    baseline = _baseline_of(args, env_id)
    if baseline is None:
        return _default_cell(_required_algo(args), env_id)
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


def _baseline_of(args: argparse.Namespace, env_id: str) -> str | None:
    """What --algo alone stands for: the baseline of its name, or else one of the algorithm's own."""
    if args.baseline is not None or args.algo is None:
        return args.baseline  # type: ignore[no-any-return]
    for family in families():
        if family.serves(env_id):
            if args.algo in family.baselines:
                return str(args.algo)
            return _default_baseline(family, args.algo, env_id, args.benchmark)
    return None


def _default_baseline(family: Family, algo: str, env_id: str, benchmark: str | None) -> str | None:
    """The first that serves the task; where none does, the first, of which it is then told why."""
    names = family.algorithms.get(algo, ())
    networks = {name: family.baselines[name].network for name in names}
    fitting = (name for name in names if serves(family.benchmarks, env_id, networks[name], benchmark))
    return next(fitting, names[0] if names else None)


def _default_preset(device: str) -> str:
    import torch

    return "paper" if device != "cpu" and torch.cuda.is_available() else "cpu"


def _default_cell(algo: str, env_id: str) -> Cell:
    """
    Return an experiment with an algorithm's own defaults.

    :raises CommandError: for an unknown algorithm, or one of ours, which have baselines instead
    """
    from zoo_configs.algorithms import ALGORITHMS, OTHERS

    if algo in ALGORITHMS:
        raise CommandError(f"no baseline of {algo} for {env_id}. Use --baseline or --conf-file.")
    if algo not in OTHERS:
        raise unknown_name("algorithm", algo, [*ALGORITHMS, *OTHERS])
    policy = "LinearPolicy" if algo == "ars" else "MlpPolicy"
    return Cell(algo, env_id, {"n_timesteps": DEFAULT_TIMESTEPS, "policy": policy})


def _with_policy_for_dicts(cell: Cell) -> Cell:
    """Replace the default policy, for vectors, by one for the observations of our environments."""
    from zoo_configs.algorithms import algorithm_classes

    aliases = algorithm_classes()[cell.algo].policy_aliases
    policies = [name for name in ("MultiInputPolicy", "MultiInputLstmPolicy") if name in aliases]
    if not policies:
        return cell
    env_kwargs = cell.hyperparams.get("env_kwargs", {})
    hyperparams: dict[str, Any] = {"policy": policies[0]}
    if _has_images(env_kwargs.get("observation", "image")):
        hyperparams["policy_kwargs"] = {"features_extractor_class": EXTRACTOR}
    return replace(cell, hyperparams=merge(merge(cell.hyperparams, hyperparams), _chosen(cell)))


def _chosen(cell: Cell) -> dict[str, Any]:
    """Return the ``policy_kwargs`` of the command line, which win over the defaults."""
    return {name: value for name, value in cell.hyperparams.items() if name == "policy_kwargs"}


def _has_images(observation: Any) -> bool:
    """Return True if a list of sensors has one that is not known to return numbers or points."""
    if isinstance(observation, str):
        return observation != "state"
    names = [entry if isinstance(entry, str) else entry.get("sensor", entry["name"]) for entry in observation]
    return any(name not in ("state", "holding", "point_cloud") for name in names)


def _cell_from_file(path: Path, algo: str, env_id: str) -> Cell:
    if path.suffix not in (".yml", ".yaml") or not path.is_file():
        raise CommandError(f"--conf-file must be a YAML file, got {path}")
    sections = read_yaml(path, "--conf-file")
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
