"""Flags that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import yaml

from zoo_configs.errors import CommandError, reason
from zoo_configs.yaml_files import format_yaml, parse_yaml

ALWAYS_AVAILABLE = ("auto", "cpu")
"""Devices that need no check, which would import PyTorch."""
MAX_SEED = 2**31 - 1


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """
        Reject the arguments.

        :param message: The reason
        :raises CommandError: always
        """
        raise CommandError(message)


class KeyValues(argparse.Action):
    """Flag with ``key:value ...``, whose values are YAML. A repeated flag adds keys."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """
        Parse the pairs of a flag.

        :param parser: The parser
        :param namespace: The parsed arguments
        :param values: The pairs
        :param option_string: The flag
        :raises CommandError: for an invalid pair or a repeated key
        """
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
    except yaml.YAMLError as error:
        raise CommandError(
            f"{flag} must be key:value with a YAML value, got {pair!r}: {reason(error)}"
        ) from error


def key_value_words(values: Mapping[str, Any]) -> list[str]:
    """
    Write parameters as the command line reads them.

    :param values: The parameters by name
    :return: One word ``key:value`` each, sorted
    """
    return [f"{name}:{format_yaml(value, inline=True)}" for name, value in sorted(values.items())]


def device(text: str) -> str:
    """
    Argument type for a PyTorch device.

    :param text: Its name
    :return: Its name
    :raises argparse.ArgumentTypeError: if the device is not available
    """
    if text in ALWAYS_AVAILABLE:
        return text
    import torch

    try:
        torch.zeros(1, device=text).cpu()
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        message = f"must be an available PyTorch device, got {text!r}: {reason(error)}"
        raise argparse.ArgumentTypeError(message) from error
    return text


def check_device(text: str) -> None:
    """
    Check a PyTorch device.

    :param text: Its name
    :raises CommandError: if the device is not available
    """
    try:
        device(text)
    except argparse.ArgumentTypeError as error:
        raise CommandError(f"--device: {error}") from error


def whole_number(least: int, most: int | None = None) -> Callable[[str], int]:
    """
    Return an argument type for whole numbers.

    :param least: Lower limit
    :param most: Upper limit, None for none
    :return: The type, which raises ``argparse.ArgumentTypeError`` for other values
    """

    def number(text: str) -> int:
        """Parse a number within the limits."""
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            limits = f"at least {least}" if most is None else f"at least {least} and at most {most}"
            raise argparse.ArgumentTypeError(f"must be a whole number of {limits}, got {text!r}")
        return value

    return number


def fraction(text: str) -> float:
    """
    Argument type for a number from 0 to 1.

    :param text: The argument
    :return: The number
    :raises argparse.ArgumentTypeError: for other values
    """
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to 1, got {text!r}")
    return value


positive_int = whole_number(1)
seed = whole_number(0, MAX_SEED)


def add_packages(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag for packages of the user.

    :param parser: Parser of the command
    """
    parser.add_argument(
        "--gym-packages",
        action="extend",
        type=lambda text: text.split(","),
        default=[],
        metavar="PACKAGE[,PACKAGE]",
        help="packages that register further environments, also from the working directory",
    )


def add_env_kwargs(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag for an environment's parameters.

    :param parser: Parser of the command
    """
    add_key_values(parser, "--env-kwargs", help="parameters of the environment, for example robot:panda")


def add_key_values(parser: argparse.ArgumentParser, *flags: str, **kwargs: Any) -> None:
    """
    Add a flag with ``key:value ...``.

    :param parser: Parser of the command
    :param flags: Its names
    :param kwargs: Further arguments of ``add_argument``
    """
    parser.add_argument(*flags, nargs="+", action=KeyValues, default={}, metavar="KEY:VALUE", **kwargs)


def add_progress(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags for progress bars. ``args.progress`` is None if neither is passed.

    :param parser: Parser of the command
    """
    add = parser.add_mutually_exclusive_group().add_argument
    on = "show a progress bar (default: on a terminal)"
    add("-P", "--progress", action="store_true", default=None, help=on)
    add("--no-progress", action="store_false", dest="progress", help="show no progress bar")


def hides_progress(progress: bool | None) -> bool | None:
    """
    Return tqdm's argument ``disable``.

    :param progress: As from :func:`add_progress`
    :return: Whether to hide the bar; None hides it without a terminal
    """
    return None if progress is None else not progress


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags that name a trained agent.

    :param parser: Parser of the command
    """
    add = parser.add_argument
    add("run", nargs="?", type=Path, metavar="RUN_FOLDER", help="a run folder, as printed by train")
    add("--env", help="instead of a folder: the newest run on this environment")
    add("--baseline", help="... of this baseline")
    add("--algo", help="... of this algorithm, or of the baseline with its name")
    add("--preset", help="... of this preset")
    add("--exp-id", type=whole_number(0), default=0, help="... with this number (default: 0, the newest)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
    add("--device", type=device, default="auto", help="PyTorch device (default: auto)")
    add_packages(parser)
    add_env_kwargs(parser)
    model = parser.add_mutually_exclusive_group()
    model.add_argument("--load-best", action="store_true", default=True, help="load the best model (default)")
    model.add_argument("--load-last", action="store_false", dest="load_best", help="load the last model")


def add_published(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag that names a published agent.

    :param parser: Parser of the command, with the flags of :func:`add_run_arguments`
    """
    what = "instead of a run: the published agent of this task, or a folder written by push"
    parser.add_argument("--published", metavar="ENV", help=what)
