"""Errors that are the user's to mend: one clear sentence, exit code 2, no traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class CommandError(Exception):
    """A command cannot do what its arguments ask; the message says why and what would work."""


def unknown_name(kind: str, got: str, valid: Iterable[str]) -> CommandError:
    """
    Error for a name that does not exist, with the nearest one that does.

    :param kind: What the name stands for, for example ``"baseline"``
    :param got: The name as it was given
    :param valid: The names that exist
    :return: The error, to be raised by the caller
    """
    names = sorted(valid)
    nearest = nearest_name(got, names)
    if nearest is not None:
        return CommandError(f"unknown {kind} {got!r}, did you mean {nearest!r}?")
    return CommandError(f"unknown {kind} {got!r}, choose from {', '.join(names) or 'nothing: none exists'}")


def nearest_name(got: str, valid: Iterable[str]) -> str | None:
    """
    The valid name most like the given one, compared without regard to case.

    :param got: The name as it was given
    :param valid: The names that exist
    :return: The nearest name, None if none is near
    """
    by_lower = {name.lower(): name for name in valid}
    matches = difflib.get_close_matches(got.lower(), by_lower, n=1, cutoff=0.5)
    return by_lower[matches[0]] if matches else None
