"""Errors in the user's arguments: one sentence, exit code 2, no traceback."""

from __future__ import annotations

import difflib
import re
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager

NEARLY_EQUAL = 0.95
"""Similarity of whole names that suffices if their characteristic parts differ."""
COLOURS = re.compile(r"\x1b\[\d+m")
MADE_BY_GYMNASIUM = " was raised from the environment creator for "
"""Start of the text with all parameters that Gymnasium appends to a ``TypeError`` of an environment."""


class CommandError(Exception):
    """A command cannot run with its arguments; the message contains the reason and, often, a remedy."""


@contextmanager
def refused(what: str, kinds: type[Exception] | tuple[type[Exception], ...] = Exception) -> Iterator[None]:
    """
    Convert errors that arguments of the user cause into errors of the command.

    :param what: Start of the message
    :param kinds: Errors to convert
    :return: Context manager
    :raises CommandError: instead of one of them
    """
    try:
        yield
    except CommandError:
        raise
    except kinds as error:
        if isinstance(error, OSError) and error.errno is not None:  # of the system, not of the arguments
            raise
        raise CommandError(f"{what}: {reason(error)}") from error


def reason(error: BaseException) -> str:
    """
    Return the message of an error in one line.

    :return: Its message, with the name of its class if the message alone is not a sentence for users
    """
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    message = " ".join(str(error).split()).partition(MADE_BY_GYMNASIUM)[0]
    explains = isinstance(error, AssertionError | CommandError | RuntimeError | ValueError) and message
    return message if explains else f"{type(error).__name__}: {message}".removesuffix(": ")


def reason_and_place(error: BaseException) -> str:
    """Return the message of an error, without colours, and the line of code that raised it."""
    *_, last = traceback.extract_tb(error.__traceback__)
    message = " ".join(COLOURS.sub("", f"{type(error).__name__}: {error}").split())
    return f"{message} ({last.filename}, line {last.lineno})"


def unknown_name(
    kind: str, got: str, valid: Iterable[str], core: Callable[[str], str] = str.lower, see: str = ""
) -> CommandError:
    """
    Return the error for an unknown name, with the nearest valid name.

    :param kind: Kind of the name, for example ``"baseline"``
    :param got: The unknown name
    :param valid: The valid names
    :param core: Function that returns the characteristic part of a name
    :param see: Where the valid names are listed, if there are too many for one line
    :return: The error, which the caller raises
    """
    names = sorted(valid)
    nearest = nearest_name(got, names, core)
    if nearest is not None:
        return CommandError(f"unknown {kind} {got!r}, did you mean {nearest!r}?")
    choices = f"choose from {', '.join(names) or 'nothing: none exists'}"
    return CommandError(f"unknown {kind} {got!r}, {see or choices}")


def check_names(kind: str, given: Iterable[str], valid: Collection[str]) -> None:
    """
    Check names.

    :param kind: Their kind in the error
    :param given: The names
    :param valid: The valid names
    :raises CommandError: for the first unknown name
    """
    for name in given:
        if name not in valid:
            raise unknown_name(kind, name, valid)


def nearest_name(got: str, valid: Iterable[str], core: Callable[[str], str] = str.lower) -> str | None:
    """
    Return the valid name that is most similar to another, regardless of case, None if no name is similar.

    :param got: The other name
    :param valid: The valid names
    :param core: Function that returns the characteristic part of a name; the whole decides between equals
    """
    names = list(valid)
    near = difflib.get_close_matches(core(got), {core(name) for name in names}, n=1)
    similar = {name.lower(): name for name in names if core(name) in near} or {n.lower(): n for n in names}
    cutoff = 0.0 if near else NEARLY_EQUAL
    found = difflib.get_close_matches(got.lower(), similar, n=1, cutoff=cutoff)
    return similar[found[0]] if found else None
