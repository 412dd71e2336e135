"""The flags that name an experiment."""

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any

from sb3_extensions.common.observations import IMAGE_AXES, space_parts
from zoo_configs.algorithms import ALGORITHMS, OTHERS, algorithm_classes
from zoo_configs.arguments import add_env_kwargs, add_key_values
from zoo_configs.environments import known_env_id, make_env, our_env_ids, package_of
from zoo_configs.errors import CommandError, check_names
from zoo_configs.experiments.config import ExperimentConfig, merge, resolve
from zoo_configs.experiments.families import Layer, families
from zoo_configs.files import read_yaml

EXTRACTOR = "sb3_extensions.encoders.extractors.CnnExtractor"
"""Features extractor for images with the algorithms of Stable-Baselines3 and sb3-contrib."""
PRESETS = "cpu, paper, or for closed-loop tasks quick"
DEFAULT_TIMESTEPS = 1_000_000
"""Time steps of a training without baseline or file, as in rl_zoo3."""
POLICIES = {"ars": "LinearPolicy", "ppo_lstm": "MlpLstmPolicy"}
"""Default policies of algorithms other than ``"MlpPolicy"``."""
DICT_POLICIES = ("MultiInputPolicy", "MultiInputLstmPolicy")


def add_experiment_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that name an experiment."""
    add = parser.add_argument
    add("--baseline", help="learner and network, see bulletarm-zoo list --baselines")
    add("--preset", help=f"{PRESETS} (default: paper with a GPU, else cpu)")
    add("--benchmark", help="benchmark that defines the parameters of a task in several benchmarks")
    add("--algo", help="algorithm, instead of its baseline or with --conf-file")
    add("--env", help="environment id, see bulletarm-zoo list")
    add("-conf", "--conf-file", type=Path, help="YAML with hyperparameters by environment id, as in rl_zoo3")
    add_key_values(parser, "-params", "--hyperparams", help="hyperparameters that replace the preset's")
    add_env_kwargs(parser)


def find_experiment(args: argparse.Namespace) -> ExperimentConfig:
    """Return the experiment of a file, a baseline or an algorithm; raise ``CommandError`` without any."""
    if args.env is None:
        raise CommandError("name an environment with --env, see bulletarm-zoo list")
    env_id = known_env_id(args.env)
    overrides = dict(args.hyperparams)
    if not isinstance(overrides.get("env_kwargs", {}), dict):
        raise CommandError(f"env_kwargs must be a mapping of parameters, got {overrides['env_kwargs']!r}")
    if args.env_kwargs:
        overrides["env_kwargs"] = merge(overrides.get("env_kwargs", {}), args.env_kwargs)
    if args.conf_file is not None:
        if args.baseline is not None:
            raise CommandError("pass --baseline or --conf-file, not both")
        return _experiment_from_file(args.conf_file, _required_algo(args), env_id).overridden(overrides)
    baseline = _baseline_of(args, env_id)
    if baseline is None:
        return _default_experiment(_required_algo(args), env_id, overrides)
    preset = default_preset(args.device or "auto") if args.preset is None else args.preset
    experiment = resolve(baseline, preset, env_id, overrides, args.benchmark)
    if args.algo not in (None, baseline, experiment.algo):
        raise CommandError(f"--algo must be {experiment.algo} for baseline {baseline!r}, got {args.algo}")
    return experiment


def packages_of(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the packages of ``--gym-packages`` and of an id such as ``my_tasks:ID``."""
    return tuple(dict.fromkeys([*args.gym_packages, *package_of(args.env or "")]))


def _required_algo(args: argparse.Namespace) -> str:
    """Return the algorithm of an experiment without baseline."""
    if args.algo is None:
        raise CommandError("name a baseline with --baseline, or an algorithm with --algo")
    for flag in ("preset", "benchmark"):
        if getattr(args, flag) is not None:
            raise CommandError(f"--{flag} requires --baseline")
    return str(args.algo)


def _baseline_of(args: argparse.Namespace, env_id: str) -> str | None:
    """Return the baseline, or that of ``--algo`` alone: the one with its name, or a default one."""
    if args.baseline is not None or args.algo is None:
        return args.baseline  # type: ignore[no-any-return]
    for family in families():
        if family.has_env(env_id):
            if args.algo in family.baselines:
                return str(args.algo)
            names = family.algorithms.get(args.algo, ())
            fitting = (name for name in names if family.has_experiment(name, env_id, args.benchmark))
            return next(fitting, names[0] if names else None)  # an error follows for the first one
    return None


def default_preset(device: str) -> str:
    """Return ``"paper"`` for a GPU, else ``"cpu"``."""
    import torch

    return "paper" if device != "cpu" and torch.cuda.is_available() else "cpu"


def _default_experiment(algo: str, env_id: str, overrides: dict[str, Any]) -> ExperimentConfig:
    """Return an experiment with an algorithm's own defaults, and a policy for our observations."""
    if algo in ALGORITHMS:
        raise CommandError(f"no baseline of {algo} for {env_id}. Use --baseline or --conf-file.")
    check_names("algorithm", [algo], [*ALGORITHMS, *OTHERS])
    policy = POLICIES.get(algo, "MlpPolicy")
    hyperparams: dict[str, Any] = {"n_timesteps": DEFAULT_TIMESTEPS, "policy": policy}
    aliases = algorithm_classes()[algo].policy_aliases
    policies = [name for name in DICT_POLICIES if name in aliases]
    if policies and env_id in our_env_ids() and "policy" not in overrides:
        hyperparams["policy"] = policies[0]
        with closing(make_env(env_id, overrides.get("env_kwargs", {}))) as env:
            shapes = [space.shape or () for space in space_parts(env.observation_space).values()]
        if IMAGE_AXES in map(len, shapes):
            hyperparams["policy_kwargs"] = {"features_extractor_class": EXTRACTOR}
    return ExperimentConfig(algo, env_id, hyperparams).overridden(overrides)


def _experiment_from_file(path: Path, algo: str, env_id: str) -> ExperimentConfig:
    if path.suffix not in (".yml", ".yaml") or not path.is_file():
        raise CommandError(f"--conf-file must be a YAML file, got {path}")
    sections = read_yaml(path, "--conf-file")
    section = sections.get(env_id, sections.get("default")) if isinstance(sections, dict) else None
    if not isinstance(section, dict):
        raise CommandError(f"{path} must have a section {env_id!r} or 'default'")
    return ExperimentConfig(algo, env_id, section, sources={"hyperparams": Layer(str(path), {})})
