"""Flags that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
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
