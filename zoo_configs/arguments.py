"""Flags that several commands share."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any, NoReturn

from zoo_configs.errors import CommandError, reason

ALWAYS_THERE = ("auto", "cpu")  # devices
MAX_SEED = 2**31 - 1


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all errors of the command line."""

    def error(self, message: str) -> NoReturn:
        """
        Refuse the arguments.

        :param message: Why
        :raises CommandError: always
        """
        raise CommandError(message)


class KeyValues(argparse.Action):
    """``key:value ...``, evaluated by rl_zoo3; only values that YAML can hold."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """
        Take the pairs behind a flag; what it is given again it adds.

        :param parser: The parser
        :param namespace: Where they go
        :param values: Words
        :param option_string: The flag
        :raises CommandError: if one is no such pair, or a key comes twice behind one flag
        """
        pairs = [_key_value(str(option_string), pair) for pair in values]
        keys = [key for key, _ in pairs]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise CommandError(f"{option_string} must have each key once, got {', '.join(twice)} more often")
        setattr(namespace, self.dest, {**getattr(namespace, self.dest, {}), **dict(pairs)})


def _key_value(flag: str, pair: str) -> tuple[str, Any]:
    from rl_zoo3.utils import StoreDict

    namespace = argparse.Namespace()
    key, _, value = pair.partition(":")
    try:
        if not key or not value:
            raise ValueError("there is no key, no colon or no value")
        store: argparse.Action = StoreDict([flag], "values")  # type: ignore[no-untyped-call]
        store(argparse.ArgumentParser(), namespace, [pair])
        return key, json.loads(json.dumps(namespace.values[key]))
    except (Exception, SystemExit) as error:  # a value may be any expression
        raise CommandError(
            f"{flag} takes key:value with a Python value (text in quotes: robot:\"'panda'\"), "
            f"got {pair!r}: {reason(error)}"
        ) from error


def device(text: str) -> str:
    """
    Argument type for a PyTorch device.

    :param text: What was given
    :return: The same
    :raises argparse.ArgumentTypeError: if there is no such device
    """
    if text in ALWAYS_THERE:
        return text
    import torch

    try:
        torch.zeros(1, device=text).cpu()
    except (RuntimeError, AssertionError) as error:  # AssertionError: PyTorch was built without it
        raise argparse.ArgumentTypeError(f"{text!r} is no device of this machine: {reason(error)}") from error
    return text


def check_device(text: str) -> None:
    """
    Check a PyTorch device.

    :param text: What was given
    :raises CommandError: if there is no such device
    """
    try:
        device(text)
    except argparse.ArgumentTypeError as error:
        raise CommandError(f"--device: {error}") from error


def whole_number(least: int, most: int | None = None) -> Callable[[str], int]:
    """
    Argument type for whole numbers.

    :param least: The least that is taken
    :param most: The greatest, None sets no limit
    :return: The type, which raises ``argparse.ArgumentTypeError`` for anything else
    """

    def number(text: str) -> int:
        """Read a number that is within the limits."""
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            takes = f"at least {least}" if most is None else f"at least {least} and at most {most}"
            raise argparse.ArgumentTypeError(f"must be a whole number of {takes}, got {text!r}")
        return value

    return number


positive_int = whole_number(1)
seed = whole_number(0, MAX_SEED)


def add_packages(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag for packages of a user's own.

    :param parser: Parser of the command
    """
    help_text = "packages that register further environments, from the working directory too"
    parser.add_argument("--gym-packages", nargs="+", default=[], help=help_text)


def add_env_kwargs(parser: argparse.ArgumentParser) -> None:
    """
    Add the flag for an environment's parameters.

    :param parser: Parser of the command
    """
    add_key_values(parser, "--env-kwargs", help="parameters of the environment; text: robot:\"'panda'\"")


def add_key_values(parser: argparse.ArgumentParser, *flags: str, **kwargs: Any) -> None:
    """
    Add a flag that takes ``key:value ...``.

    :param parser: Parser of the command
    :param flags: Its names
    :param kwargs: More for ``add_argument``
    """
    parser.add_argument(*flags, nargs="+", action=KeyValues, default={}, metavar="KEY:VALUE", **kwargs)


def add_progress(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags for progress bars: ``args.progress`` is None where neither is given.

    :param parser: Parser of the command
    """
    add = parser.add_mutually_exclusive_group().add_argument
    on = "show a progress bar (default: on a terminal)"
    add("-P", "--progress", action="store_true", default=None, help=on)
    add("--no-progress", action="store_false", dest="progress", help="show no progress bar")


def hides_progress(progress: bool | None) -> bool | None:
    """
    What tqdm takes as ``disable``.

    :param progress: As from :func:`add_progress`
    :return: Whether to hide the bar, None hides it where there is no terminal
    """
    return None if progress is None else not progress
