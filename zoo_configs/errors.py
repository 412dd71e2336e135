"""Errors in the user's arguments: one sentence, exit code 2, no traceback."""

import difflib
import re
import traceback
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager

SIMILAR = 0.65
"""Least similarity (difflib's ratio) of a suggested name."""
COLOURS = re.compile(r"\x1b\[\d+m")
MADE_BY_GYMNASIUM = " was raised from the environment creator for "
"""Start of the text with all parameters that Gymnasium appends to a ``TypeError`` of an environment."""


class CommandError(Exception):
    """A command cannot run with its arguments; the message contains the reason and, often, a remedy."""


@contextmanager
def refused(
    what: str, kinds: type[BaseException] | tuple[type[BaseException], ...] = Exception
) -> Iterator[None]:
    """Convert errors that the user's arguments cause into ``CommandError`` that starts with ``what``."""
    try:
        yield
    except CommandError:
        raise
    except kinds as error:
        if isinstance(error, OSError) and error.errno is not None:  # of the system, not of the arguments
            raise
        raise CommandError(f"{what}: {reason(error)}") from error


def reason(error: BaseException) -> str:
    """Return the message of an error in one line, with the name of its class if it is not one of ours."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    message = " ".join(str(error).split()).partition(MADE_BY_GYMNASIUM)[0]
    explains = isinstance(error, AssertionError | CommandError | RuntimeError | ValueError) and message
    return message if explains else f"{type(error).__name__}: {message}".removesuffix(": ")


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the errors that caused it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def reason_and_place(error: BaseException) -> str:
    """Return the message of an error, without colours, and the line of code that raised it."""
    *_, last = traceback.extract_tb(error.__traceback__)
    message = " ".join(COLOURS.sub("", f"{type(error).__name__}: {error}").split())
    return f"{message} ({last.filename}, line {last.lineno})"


def unknown_name(kind: str, got: object, valid: Iterable[str], see: str = "") -> CommandError:
    """
    Return the error for an unknown name, with the nearest valid name regardless of case, namespace, version.

    :param kind: Kind of the name, for example ``"baseline"``
    :param see: Where the valid names are listed, if there are too many for one line
    """
    names = sorted(valid)
    bare = {_bare(name): name for name in names}
    if nearest := difflib.get_close_matches(_bare(str(got)), bare, n=1, cutoff=SIMILAR):
        return CommandError(f"unknown {kind} {got!r}, did you mean {bare[nearest[0]]!r}?")
    choices = f"choose from {', '.join(names) or 'nothing: none exists'}"
    return CommandError(f"unknown {kind} {got!r}, {see or choices}")


def check_names(kind: str, given: Iterable[str], valid: Collection[str]) -> None:
    """Raise ``CommandError`` for the first of some names that is not valid."""
    for name in given:
        if name not in valid:
            raise unknown_name(kind, name, valid)


def _bare(name: str) -> str:
    return name.lower().rpartition("/")[2].partition("-v")[0]
