"""Arguments that the programs of this package share."""

import argparse
import importlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium

from bulletarm_gym.env import ManipulationEnv


def add_environment_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that :func:`make_env` and the seeds of episodes need."""
    add = parser.add_argument
    many: dict[str, Any] = {"action": "extend", "default": []}
    text = "seed of the first episode; each further episode adds 1 (0)"
    add("--seed", type=integer_from(0), default=0, help=text)
    text = "parameters of the environment; a value is JSON, or else text"
    add("--env-kwargs", nargs="+", type=_key_value, metavar="KEY:VALUE", help=text, **many)
    text = "modules to import, which register your own tasks and components"
    add("--gym-packages", type=lambda names: names.split(","), metavar="MODULE[,MODULE]", help=text, **many)


def _key_value(text: str) -> tuple[str, Any]:
    key, _, value = text.partition(":")
    if not key or not value:
        raise argparse.ArgumentTypeError(f"must be KEY:VALUE, got {text!r}")
    try:
        return key, json.loads(value)
    except ValueError:
        return key, value


def integer_from(least: int) -> Callable[[str], int]:
    """Return the type of arguments that are integers of at least ``least``."""

    def integer(text: str) -> int:
        if (value := int(text)) < least:
            raise argparse.ArgumentTypeError(f"must be at least {least}, got {value}")
        return value

    return integer


@contextmanager
def reported_errors(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Exit with one line and status 2 if an argument causes an error."""
    try:
        yield
    except (ImportError, OSError, ValueError, gymnasium.error.Error) as error:
        parser.error(" ".join(str(error).split()))


def make_env(env_id: str, args: argparse.Namespace, **parameters: Any) -> gymnasium.Env[Any, Any]:
    """Make an environment with the parameters of ``--env-kwargs``.

    :param parameters: default values of further parameters
    :raises ValueError: it is of another package, or a parameter is invalid
    """
    for module in args.gym_packages:
        importlib.import_module(module)
    env = gymnasium.make(env_id, **{**parameters, **dict(args.env_kwargs)})
    if not isinstance(env.unwrapped, ManipulationEnv):
        env.close()
        raise ValueError(f"ID must be an environment of this package or of a registered task, got {env_id}")
    return env
