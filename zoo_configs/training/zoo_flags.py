"""The flags of ``rl_zoo3.train``: its own parser, and what of them can be followed here."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

from zoo_configs.arguments import Parser, device
from zoo_configs.errors import CommandError, refused

TUNING = (
    "max_total_trials",
    "n_evaluations",
    "n_jobs",
    "n_startup_trials",
    "n_trials",
    "no_optim_plots",
    "optimization_log_path",
    "optimize_hyperparameters",
    "pruner",
    "sampler",
    "storage",
    "study_name",
    "trial_id",
)
COUNTS = ("eval_episodes", "n_eval_envs", "n_timesteps", "num_threads")
DEFAULT_THREADS = ("num_threads", -1)  # which rl_zoo3 documents
# Packages that rl_zoo3 does not require, by the flag that does.
PACKAGES = {"tensorboard_log": ("tensorboard",), "track": ("wandb", "tensorboard")}
NOT_GIVEN = object()


class _Found(Exception):
    """Carries rl_zoo3's parser out of the function that builds it."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        super().__init__()
        self.parser = parser


class _ParserOfRlZoo3(Parser):
    """Stops where rl_zoo3 would parse ``sys.argv``."""

    def parse_args(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise _Found(self)


@contextmanager
def train_module() -> Iterator[Any]:
    """
    rl_zoo3's module for training, with our algorithms in its table; what is replaced in it is put back.

    :return: Context manager of the module
    """
    import rl_zoo3.train

    from zoo_configs.algorithms import register_algorithms

    register_algorithms()
    before = dict(vars(rl_zoo3.train))
    try:
        yield rl_zoo3.train
    finally:
        vars(rl_zoo3.train).update(before)


def parser_of_rl_zoo3(prog: str) -> argparse.ArgumentParser:
    """
    The parser of ``rl_zoo3.train``, which exists inside its main function only.

    :param prog: Name of the program, for its help
    :return: A parser of ``parse_known_args``; its errors are a :class:`CommandError`
    """
    with train_module() as train:
        train.argparse = SimpleNamespace(ArgumentParser=_ParserOfRlZoo3)
        try:
            train.train()
        except _Found as found:
            found.parser.prog = prog
            return found.parser
    raise AssertionError("rl_zoo3.train parses no arguments")


def check_flags(arguments: Sequence[str]) -> dict[str, Any]:
    """
    Check the flags for ``rl_zoo3.train``, those that are given and not their defaults.

    :param arguments: The words that it will be given
    :return: Those that are given
    :raises CommandError: if one is unknown, has a value that it cannot take, or needs what is not there
    """
    given = given_flags(arguments)
    if tuning := [_flag(name) for name in TUNING if name in given]:
        raise CommandError(f"train does not tune: {', '.join(tuning)}")
    for name in COUNTS:
        if given.get(name, 1) < 1 and (name, given[name]) != DEFAULT_THREADS:
            raise CommandError(f"{_flag(name)} takes a whole number of at least 1, got {given[name]}")
    for name, packages in PACKAGES.items():
        missing = [package for package in packages if given.get(name) and find_spec(package) is None]
        if missing:
            raise CommandError(f"{_flag(name)} needs what is not installed: pip install {' '.join(missing)}")
    if (agent := given.get("trained_agent")) is not None:
        check_trained_agent(Path(agent))
    try:
        device(given.get("device", "auto"))
    except argparse.ArgumentTypeError as error:
        raise CommandError(f"--device: {error}") from error
    return given


def check_trained_agent(path: Path) -> None:
    """
    Check the model that training is to go on from.

    :param path: As given to ``-i``
    :raises CommandError: if there is no such model
    """
    if path.suffix != ".zip" or not path.is_file():
        raise CommandError(f"--trained-agent takes the .zip file of a model, got {path}")


def given_flags(arguments: Sequence[str]) -> dict[str, Any]:
    """
    Parse arguments as ``rl_zoo3.train`` will.

    :param arguments: Words
    :return: The flags that are given, without the defaults of others
    :raises CommandError: if they cannot be parsed
    """
    parser = parser_of_rl_zoo3("bulletarm-zoo train")
    defaults, _ = parser.parse_known_args([])
    absent = argparse.Namespace(**dict.fromkeys(vars(defaults), NOT_GIVEN))
    with refused("--eval-env-kwargs takes key:value with a Python value"):  # evaluated while parsing
        given, unknown = parser.parse_known_args(arguments, absent)
    if unknown:
        raise CommandError(f"unknown argument {unknown[0]!r}, see bulletarm-zoo train --help")
    return {name: value for name, value in vars(given).items() if value is not NOT_GIVEN}


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
