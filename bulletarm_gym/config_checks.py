"""Checks of parameters: each returns a valid value as a plain Python value, or raises :class:`Refused`."""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

Check = Callable[[Any], Any]

MIN_WORKSPACE = 0.04
"""Minimum side length (m) of a workspace, which has room for a cube of 1.5 cm."""
ROUNDING = 1e-9
"""Tolerance (m) of differences of decimal fractions."""
MAX_SCALE = 2.0
"""Maximum scale of objects; a cube of twice the nominal size (10 cm) fits no gripper."""
MAX_SHOWN = 500
"""Maximum number of characters of a value in an error."""
SIGNS = {"finite": -math.inf, "non-negative": 0.0, "positive": math.ulp(0.0)}
"""Lowest number of each sign."""


class ParameterError(ValueError):
    """A parameter is unknown or has an invalid value.

    Its only argument is the text, so that other processes and Gymnasium can construct it again.
    """

    @classmethod
    def of(cls, name: str, got: object, must: str, reason: str = "") -> "ParameterError":
        """Return the error of a parameter with a constraint on its value."""
        text = repr(got)
        shown = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
        return cls(f"{name} must be {must}, got {shown}{': ' if reason else ''}{reason}")


class Refused(ValueError):
    """A value is not valid; the text is the constraint."""


def check_argument(name: str, value: Any, check: Check) -> Any:
    """Return an argument of a function as a check returns it, or raise a :class:`ParameterError`."""
    try:
        return check(value)
    except Refused as refused:
        raise ParameterError.of(name, value, str(refused)) from None


def check_fields(record: Any, checks: Mapping[str, Check], of: str = "") -> None:
    """Replace fields of a frozen dataclass by what their checks return.

    :param of: end of the names in errors, such as ``" of 'cube'"``
    """
    for name, check in checks.items():
        object.__setattr__(record, name, check_argument(f"{name}{of}", getattr(record, name), check))


def _plain(value: Any) -> Any:
    is_number = isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0)
    return value.item() if is_number else value


def _is_number(value: Any) -> bool:
    return type(_plain(value)) in (int, float)


def _float(value: Any) -> float:
    return value if type(value) is float else float(value) if _is_number(value) else math.nan


def _pair(value: Any) -> Any:
    """Return a number twice; return other values as they are."""
    return [value, value] if _is_number(value) else value


def listed(value: Any) -> list[Any] | None:
    """Return an array-like as a list, None for text and other values."""
    value = _plain(value)
    is_sequence = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes)
    return list(value) if is_sequence else None


def floats(*shape: int) -> Callable[[Any], Any]:
    """Return a conversion of array-likes of finite numbers to lists."""

    def convert(value: Any) -> Any:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" or array.shape != shape or not np.isfinite(array).all():
            raise ValueError
        return array.astype(np.float64).tolist()

    return convert


def rule(must: str, accepts: Callable[[Any], bool], convert: Callable[[Any], Any] = _plain) -> Check:
    """Return a check.

    :param must: description of the accepted values
    :param accepts: function that returns True for valid converted values
    :param convert: conversion to plain Python values; it may raise errors for invalid ones
    """

    def check(value: Any) -> Any:
        try:
            converted = convert(value)
            is_valid = accepts(converted)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            is_valid = False
        if not is_valid:
            raise Refused(must)
        return converted

    return check


def optional(inner: Check) -> Check:
    """Accept None and the values of another check."""
    return lambda value: None if value is None else inner(value)


def choice(*choices: Any, must: str = "") -> Check:
    """Accept some values, of exactly their types."""
    text = must or "one of " + ", ".join(map(repr, choices))
    return rule(text, lambda value: any(type(value) is type(one) and value == one for one in choices))


def integer(low: int, high: int | None = None) -> Check:
    """Accept integers between limits, both included."""
    text = f"an integer of at least {low}" + ("" if high is None else f" and at most {high}")
    most = math.inf if high is None else high
    return rule(text, lambda value: type(value) is int and low <= value <= most)


def number(low: float, high: float, must: str) -> Check:
    """Accept finite numbers between limits, both included."""
    return rule(must, lambda value: low <= value <= high and math.isfinite(value), _float)


fraction = number(0.0, 1.0, "a number from 0 to 1")
"""Accept numbers from 0 to 1."""


@cache
def numbers(sign: str = "finite", count: int | None = None) -> Check:
    """Accept a finite number, or some numbers and return a tuple.

    :param sign: one of :data:`SIGNS`
    :param count: number of numbers, None for one that is not in a tuple
    """
    low = SIGNS[sign]
    if count is None:
        return number(low, math.inf, f"a {sign} number")

    def accepts(values: tuple[float, ...]) -> bool:
        return len(values) == count and all([low <= value and math.isfinite(value) for value in values])

    text = f"{count} {sign} number{'' if count == 1 else 's'}"
    return rule(text, accepts, lambda values: tuple(map(_float, values)))


def instance(*kinds: type) -> Check:
    """Accept instances of some classes."""
    names = " or ".join(kind.__name__ for kind in kinds)
    return rule(f"an instance of {names}", lambda value: isinstance(value, kinds), lambda value: value)


def instances(kind: type | tuple[type, ...], names: str, can_be_empty: bool = True) -> Check:
    """Accept a sequence of instances of one or several classes, and return a tuple.

    :param names: name of several instances
    """

    def accepts(values: list[Any]) -> bool:
        return len(values) >= 1 - can_be_empty and all(isinstance(value, kind) for value in values)

    check = rule(f"a {'' if can_be_empty else 'non-empty '}tuple of {names}", accepts, listed)
    return lambda value: tuple(check(value))


def interval(low: float, high: float) -> Check:
    """Accept numbers and [low, high] between limits, both included; return [low, high]."""
    return rule(
        f"a number or [low, high], from {low:g} to {high:g}",
        lambda ends: low <= ends[0] <= ends[1] <= high,
        lambda value: floats(2)(_pair(value)),
    )


def action_sequence(known: Sequence[str]) -> Check:
    """Accept words, their characters in any order."""
    words = " or ".join(filter(None, (", ".join(map(repr, known[:-1])), repr(known[-1]))))
    text = f"{words}, the characters in any order"
    return rule(text, lambda value: isinstance(value, str) and sorted(value) in map(sorted, known))


def robot(names: Sequence[str]) -> Check:
    """Accept text; whether a robot with that name or import path exists is checked when it is loaded."""
    text = f"one of {', '.join(map(repr, names))}, a RobotModel or 'module:attribute'"
    return rule(text, lambda value: isinstance(value, str))


boolean = rule("True or False", lambda value: isinstance(value, bool))
mapping = rule("a dict", lambda value: isinstance(value, Mapping))
function = rule("a function", callable)
truth = rule("True or False", lambda value: not isinstance(value, str) and bool(value) in (True, False))
colour = rule("4 numbers from 0 to 1", lambda parts: 0 <= min(parts) <= max(parts) <= 1, numbers(count=4))
positive = number(math.nextafter(0.0, 1.0), math.inf, "a positive number of metres")
field_of_view = number(1.0, 170.0, "a number of degrees from 1 to 170")
point = rule("[x, y, z] in metres", bool, floats(3))


def _is_workspace(limits: list[list[float]]) -> bool:
    x, y, z = (high - low for low, high in limits)
    is_square = math.isclose(x, y, abs_tol=ROUNDING)
    return x >= MIN_WORKSPACE - ROUNDING and is_square and z > 0.0 and limits[2][0] >= 0.0


workspace = rule(
    "[[x low, x high], [y low, y high], [z low, z high]] in metres, square in x and y with sides "
    f"of at least {MIN_WORKSPACE:g}, z low not below 0",
    _is_workspace,
    floats(3, 2),
)
scale_range = rule(
    f"a positive number or [low, high], at most {MAX_SCALE}",
    lambda limits: 0.0 < limits[0] <= limits[1] <= MAX_SCALE,
    lambda value: floats(2)(_pair(value)),
)
render_size = rule(
    "a number of pixels or [width, height], each from 16 to 4096",
    lambda sides: len(sides) == 2,
    lambda value: [integer(16, 4096)(side) for side in _pair(value)],
)


def function_path(preset: str) -> Check:
    """Accept one word and import paths of functions."""

    def accepts(value: Any) -> bool:
        parts = value.replace(":", ".").split(".")
        return value == preset or (value.count(":") == 1 and all(map(str.isidentifier, parts)))

    return rule(f'None, "{preset}" or "module:function"', accepts)


CAMERA: dict[str, Check] = {"position": point, "target": point, "fov": field_of_view}
camera = rule(
    "None or a dict with some of 'position' and 'target', [x, y, z] in metres, and 'fov', 1 to 170 degrees",
    lambda _: True,
    lambda value: {name: CAMERA[name](entry) for name, entry in dict(value).items()},
)


def object_set(value: Any) -> str | list[str]:
    """Accept an existing folder, as an absolute path, or a list of kinds of objects."""
    kinds = listed(value)
    if kinds and all(isinstance(kind, str) for kind in kinds):
        return [str(kind) for kind in kinds]
    if not isinstance(value, str | os.PathLike):
        raise Refused("None, a folder of OBJ, STL or URDF files, or a list of kinds of objects")
    if not os.path.isdir(value):
        where = "" if os.path.isabs(value) else f" in the working directory {os.getcwd()}"
        raise Refused(f"None, an existing folder{where} or a list of kinds of objects")
    return os.path.abspath(os.fspath(value))


def observation(presets: Sequence[str], builtin: Sequence[str]) -> Check:
    """Accept the name of a preset, or a list of sensors: names, or dicts with a name and parameters.

    :param presets: names of lists of sensors
    :param builtin: names of built-in sensors, which other sensors cannot have
    """
    text = (
        f"{' or '.join(map(repr, presets))}, or a list of some of {', '.join(builtin)} and other sensors: "
        'distinct names and dicts {"name": identifier, parameter: value} with JSON values'
    )

    def convert(value: Any) -> str | list[Any]:
        entries = listed(value)
        return presets[presets.index(value)] if entries is None else [_sensor(e, builtin) for e in entries]

    def accepts(entries: str | list[Any]) -> bool:
        names = [entry if isinstance(entry, str) else entry["name"] for entry in entries]
        return isinstance(entries, str) or 0 < len(set(names)) == len(names)

    return rule(text, accepts, convert)


def _sensor(entry: Any, builtin: Sequence[str]) -> str | dict[str, Any]:
    """Return the name of a sensor, or a dict with its name, parameters and, for a user's, import path."""
    if isinstance(entry, str):
        return str(entry)
    plain: dict[str, Any] = json.loads(json.dumps(dict(entry), default=_to_json))
    name = plain["name"]
    if not str.isidentifier(name) or (name in builtin and plain.get("sensor", name) != name):
        raise ValueError
    return plain


def _to_json(value: Any) -> Any:
    """Return NumPy's arrays and numbers, and other sequences and mappings, as Python's."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if (entries := listed(value)) is not None:
        return entries
    raise TypeError(f"{type(value).__name__} is not a JSON value")
