"""Flags that several commands share."""

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import yaml

from zoo_configs.errors import CommandError, reason
from zoo_configs.files import format_yaml, parse_yaml

MAX_SEED = 2**31 - 1


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Raise ``CommandError`` with a message."""
        raise CommandError(message)


class KeyValues(argparse.Action):
    """Flag with ``key:value ...``, whose values are YAML. A repeated flag adds keys."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Parse the pairs of a flag; raise ``CommandError`` for an invalid pair or a repeated key."""
        pairs = [_key_value(str(option_string), pair) for pair in values]
        keys = [key for key, _ in pairs]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise CommandError(f"{option_string} must have each key once, got {', '.join(twice)} more often")
        setattr(namespace, self.dest, {**getattr(namespace, self.dest, {}), **dict(pairs)})


def _key_value(flag: str, pair: str) -> tuple[str, Any]:
    key, _, text = pair.partition(":")
    if not key or not text:
        raise CommandError(f"{flag} must be key:value ..., got {pair!r}")
    try:
        return key, parse_yaml(text)
    except (ValueError, yaml.YAMLError) as error:
        raise CommandError(
            f"{flag} must be key:value with a YAML value, got {pair!r}: {reason(error)}"
        ) from error


def key_value_words(values: Mapping[str, Any]) -> list[str]:
    """Return one word ``key:value`` for each parameter, sorted, as the command line reads them."""
    return [f"{name}:{format_yaml(value, inline=True)}" for name, value in sorted(values.items())]


def check_device(name: str) -> None:
    """Raise ``CommandError`` if a PyTorch device is not available."""
    if name in ("auto", "cpu"):
        return  # without importing PyTorch
    import torch

    try:
        torch.zeros(1, device=name).cpu()
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        raise CommandError(
            f"--device must be an available PyTorch device, got {name!r}: {reason(error)}"
        ) from error


def whole_number(least: int, most: float = math.inf) -> Callable[[str], int]:
    """Return an argument type for whole numbers from ``least`` to ``most``."""

    def integer(text: str) -> int:
        """Parse a number within the limits."""
        value = int(text)
        if not least <= value <= most:
            limits = f"at least {least}" if most == math.inf else f"from {least} to {most}"
            raise argparse.ArgumentTypeError(f"must be a whole number {limits}, got {text!r}")
        return value

    return integer


def positive_number(text: str) -> float:
    """Parse a finite number greater than 0."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be greater than 0, got {text!r}")
    return value


def folder_name(text: str) -> str:
    """Parse the name of a folder, without a path."""
    if text == ".." or Path(text).name != text:
        raise argparse.ArgumentTypeError(f"must be a name without a path, got {text!r}")
    return text


positive_int = whole_number(1)
seed = whole_number(0, MAX_SEED)


def add_packages(parser: argparse.ArgumentParser) -> None:
    """Add the flag for packages of the user."""
    parser.add_argument(
        "--gym-packages",
        action="extend",
        type=lambda text: text.split(","),
        default=[],
        metavar="PACKAGE[,PACKAGE]",
        help="packages that register further environments, also from the working directory",
    )


def add_env_kwargs(parser: argparse.ArgumentParser) -> None:
    """Add the flag for an environment's parameters."""
    add_key_values(parser, "--env-kwargs", help="parameters of the environment, for example robot:panda")


def add_key_values(parser: argparse.ArgumentParser, *flags: str, **kwargs: Any) -> None:
    """Add a flag with ``key:value ...``; ``kwargs`` are further arguments of ``add_argument``."""
    parser.add_argument(*flags, nargs="+", action=KeyValues, default={}, metavar="KEY:VALUE", **kwargs)


def add_run_filters(parser: argparse.ArgumentParser) -> None:
    """Add the flags that select runs of a folder."""
    parser.add_argument("--seed", nargs="+", type=seed, help="seeds of the runs (default: all)")
    parser.add_argument("--device", help="runs with this --device (default: all)")


def add_progress(parser: argparse.ArgumentParser) -> None:
    """Add the flags for progress bars."""
    on_off, text = argparse.BooleanOptionalAction, "show a progress bar (default: on a terminal)"
    parser.add_argument("-P", "--progress", action=on_off, help=text)
    parser.set_defaults(progress=sys.stderr.isatty())


def add_agent_flags(parser: argparse.ArgumentParser, is_run: bool = False) -> None:
    """Add the flags that describe an agent, with ``is_run`` that of a run, and its test scenes."""
    add = parser.add_argument
    if is_run:
        add("path", nargs="?", type=Path, metavar="RUN_FOLDER", help="run folder, as train prints it")
    else:
        model = "run folder, as train prints it, or a model that save() wrote (with --env)"
        add("path", nargs="?", type=Path, metavar="RUN_FOLDER|FILE.zip", help=model)
        add("--published", metavar="TASK", help="agent of the package, or a folder written by push")
    add("--env", help="environment id; without a path the newest run on this environment is loaded")
    add("--baseline", help="load the newest run of this baseline")
    add("--algo", help="load the newest run of this algorithm, or of the baseline of this name")
    add("--preset", help="load the newest run with this preset")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--load-best", action="store_true", default=True, help="load the best model (the default)")
    add("--load-last", action="store_false", dest="load_best", help="load the last model")
    add_packages(parser)
    add_env_kwargs(parser)
    add_progress(parser)
