"""Errors that are the user's to mend: one clear sentence, exit code 2, no traceback."""

from __future__ import annotations

import difflib
import re
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager

# Share of letters that two names must have in common to be taken for one another: of what tells them from
# others, or of the whole.
NEAR, NEARLY_EQUAL = 0.6, 0.95
COLOURS = re.compile(r"\x1b\[\d+m")
MADE_BY_GYMNASIUM = " was raised from the environment creator for "
"""Begin of the text that Gymnasium appends to a ``TypeError`` of an environment: all of its parameters."""


class CommandError(Exception):
    """A command cannot do what its arguments ask; the message says why and what would work."""


@contextmanager
def refused(what: str, kinds: type[Exception] | tuple[type[Exception], ...] = Exception) -> Iterator[None]:
    """
    Tell errors of what a user's arguments are handed to as errors of the command.

    :param what: What cannot be done
    :param kinds: The errors that are the arguments' fault
    :return: Context manager
    :raises CommandError: in place of one of them
    """
    try:
        yield
    except CommandError:
        raise
    except kinds as error:
        if isinstance(error, OSError) and error.errno is not None:  # the system's: not the arguments' fault
            raise
        raise CommandError(f"{what}: {reason(error)}") from error


def reason(error: BaseException) -> str:
    """
    What an error says, in one line.

    :param error: The error
    :return: Its message; with its name where the message is for who raised it, not for who reads it
    """
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    said = " ".join(str(error).split()).partition(MADE_BY_GYMNASIUM)[0]
    explains = isinstance(error, AssertionError | CommandError | RuntimeError | ValueError) and said
    return said if explains else f"{type(error).__name__}: {said}".removesuffix(": ")


def reason_and_place(error: BaseException) -> str:
    """
    What an error says, and where in the code it arose: for those whose task or policy raised it.

    :param error: The error, as it was caught
    :return: One line, without the colours of Gymnasium's warnings
    """
    *_, last = traceback.extract_tb(error.__traceback__)
    said = " ".join(COLOURS.sub("", f"{type(error).__name__}: {error}").split())
    return f"{said} ({last.filename}, line {last.lineno})"


def unknown_name(
    kind: str, got: str, valid: Iterable[str], core: Callable[[str], str] = str.lower, see: str = ""
) -> CommandError:
    """
    Error for a name that does not exist, with the nearest one that does.

    :param kind: What the name stands for, for example ``"baseline"``
    :param got: The name as it was given
    :param valid: The names that exist
    :param core: What of a name tells it from the others
    :param see: Where they are listed, if they are too many for a line
    :return: The error, to be raised by the caller
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
    The valid name most like the given one, compared without regard to case.

    :param got: The name as it was given
    :param valid: The names that exist
    :param core: What of a name tells it from the others; between equals the whole decides
    :return: The nearest name, None if none is near
    """
    names = list(valid)
    scores = [(_likeness(core(got), core(name)), _likeness(got.lower(), name.lower())) for name in names]
    near = [score for score in scores if score[0] >= NEAR or score[1] >= NEARLY_EQUAL]
    return names[scores.index(max(near))] if near else None


def _likeness(left: str, right: str) -> float:
    """Share of letters that two names have in common, in order."""
    return difflib.SequenceMatcher(a=left, b=right).ratio()
