"""Checks of parameters: each returns a valid value as a plain Python value, or raises :class:`Refused`."""

import difflib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

Check = Callable[[Any], Any]

MIN_WORKSPACE = 0.04
"""Minimum side length (m) of a workspace, which has room for a cube of 1.5 cm."""
ROUNDING = 1e-9
"""Tolerance (m) of differences of decimal fractions."""
MAX_SCALE = 2.0
"""Maximum scale of objects; a cube of twice the nominal size (10 cm) fits no gripper."""
RENDER_SIZES = (16, 4096)
"""Minimum and maximum side length (pixels) of rendered images."""


class ParameterError(ValueError):
    """A parameter is unknown or has an invalid value.

    Its only argument is the text, so that other processes and Gymnasium can construct it again.
    """

    @classmethod
    def of(cls, name: str, got: object, must: str, reason: str = "") -> "ParameterError":
        """Return the error of a parameter.

        :param must: what the value must be
        :param reason: why the value is not valid
        """
        return cls(f"{name} must be {must}, got {got!r}{': ' if reason else ''}{reason}")


class Refused(Exception):
    """A value is not valid; the text says what it must be."""


def check_argument(name: str, value: Any, check: Check) -> Any:
    """Return an argument of a function as a check returns it.

    :raises ParameterError: the value is not valid
    """
    try:
        return check(value)
    except Refused as refused:
        raise ParameterError.of(name, value, str(refused)) from None


def describe(check: Check) -> str:
    """Return the description of the accepted values that error messages show."""
    try:
        check(object())
    except Refused as refused:
        return str(refused)
    raise AssertionError(f"{check} accepts every value")


def optional(inner: Check) -> Check:
    """Accept None and the values of another check."""
    return lambda value: None if value is None else inner(value)


def fixed(default: Any, reason: str) -> Check:
    """Accept one value only.

    :param reason: why the task has no other value
    """

    def check(value: Any) -> Any:
        if type(value) is not type(default) or value != default:
            raise Refused(f"{default!r} with this task: {reason}")
        return value

    return check


def mapping(value: Any) -> Mapping[str, Any]:
    """Accept a dict."""
    if not isinstance(value, Mapping):
        raise Refused("a dict")
    return value


def choice(*choices: Any) -> Check:
    """Accept some values, of exactly their types."""

    def check(value: Any) -> Any:
        plain = value.item() if isinstance(value, np.generic) else value
        if not any(type(plain) is type(known) and plain == known for known in choices):
            raise Refused("one of " + ", ".join(map(repr, choices)))
        return plain

    return check


def boolean(value: Any) -> bool:
    """Accept True and False."""
    if not isinstance(value, bool | np.bool_):
        raise Refused("True or False")
    return bool(value)


def integer(low: int, high: int | None = None) -> Check:
    """Accept integers between limits, both included."""

    def check(value: Any) -> int:
        is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not is_integer or value < low or (high is not None and value > high):
            raise Refused(f"an integer of at least {low}" + (f" and at most {high}" if high else ""))
        return int(value)

    return check


def number(low: float, high: float, must: str) -> Check:
    """Accept numbers between limits, both included.

    :param must: description of the numbers
    """

    def check(value: Any) -> float:
        if not _is_number(value) or not low <= float(value) <= high:
            raise Refused(must)
        return float(value)

    return check


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


positive = number(math.nextafter(0.0, 1.0), math.nextafter(math.inf, 0.0), "a positive number of metres")
"""Accept positive, finite lengths (m)."""
field_of_view = number(1.0, 170.0, "a number of degrees from 1 to 170")
"""Accept vertical fields of view (degrees) of a camera."""


def numbers(value: Any, shape: tuple[int, ...], must: str) -> Any:
    """Return an array-like of finite numbers as lists.

    :param must: description of the array
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise Refused(must) from None
    if array.shape != shape or not np.isfinite(array).all():
        raise Refused(must)
    return array.tolist()


def point(value: Any) -> list[float]:
    """Accept the coordinates of a point."""
    found: list[float] = numbers(value, (3,), "[x, y, z] in metres")
    return found


def workspace(value: Any) -> list[list[float]]:
    """Accept limits along x, y and z."""
    must = (
        "[[x low, x high], [y low, y high], [z low, z high]] in metres, square in x and y with sides "
        f"of at least {MIN_WORKSPACE:g}, z low not below 0"
    )
    limits: list[list[float]] = numbers(value, (3, 2), must)
    x, y, z = (high - low for low, high in limits)
    is_square = math.isclose(x, y, abs_tol=ROUNDING)
    if not (x >= MIN_WORKSPACE - ROUNDING and is_square and z > 0.0 and limits[2][0] >= 0.0):
        raise Refused(must)
    return limits


def scale_range(value: Any) -> list[float]:
    """Accept a scale or a range of scales."""
    must = f"a positive number or [low, high], at most {MAX_SCALE}"
    limits: list[float] = numbers([value, value] if _is_number(value) else value, (2,), must)
    if not 0.0 < limits[0] <= limits[1] <= MAX_SCALE:
        raise Refused(must)
    return limits


def render_size(value: Any) -> list[int]:
    """Accept the size of rendered images; an integer is the side length of a square."""
    low, high = RENDER_SIZES
    pair = [value, value] if isinstance(value, int | np.integer) else value
    try:
        width, height = map(integer(low, high), pair)
    except (Refused, TypeError, ValueError):
        raise Refused(f"a number of pixels or [width, height], each from {low} to {high}") from None
    return [width, height]


def camera(value: Any) -> dict[str, Any]:
    """Accept a dict with some of the position, target and field of view of a camera."""
    checks: dict[str, Check] = {"position": point, "target": point, "fov": field_of_view}
    if not isinstance(value, Mapping) or not value.keys() <= checks.keys():
        raise Refused(f"None or a dict with some of {', '.join(map(repr, checks))}")
    try:
        return {name: checks[name](entry) for name, entry in value.items()}
    except Refused as refused:
        raise Refused(f"a dict in which each of {', '.join(value)} is valid: {refused}") from None


def object_set(value: Any) -> str | list[str]:
    """Accept an existing folder, as an absolute path, or a list of kinds of objects."""
    if isinstance(value, list | tuple) and value and all(isinstance(kind, str) for kind in value):
        return [str(kind) for kind in value]
    if not isinstance(value, str | os.PathLike):
        raise Refused("None, a folder of OBJ, STL or URDF files, or a list of kinds of objects")
    if not os.path.isdir(value):
        where = "" if os.path.isabs(value) else f" in the working directory {os.getcwd()}"
        raise Refused(f"None, an existing folder{where} or a list of kinds of objects")
    return os.path.abspath(os.fspath(value))


def function_path(value: Any) -> str:
    """Accept an import path."""
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise Refused('None or "module:function"')
    return str(value)


def action_sequence(known: Sequence[str]) -> Check:
    """Accept words, their characters in any order."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or sorted(value) not in [sorted(word) for word in known]:
            words = " or ".join(filter(None, (", ".join(map(repr, known[:-1])), repr(known[-1]))))
            raise Refused(f"{words}, the characters in any order")
        return value

    return check


def robot(names: Sequence[str]) -> Check:
    """Accept the name or the import path of a robot."""

    def check(value: Any) -> str:
        if value in names or (isinstance(value, str) and ":" in value):
            return str(value)
        raise Refused(f"one of {', '.join(map(repr, names))}, a RobotModel or 'module:attribute'")

    return check


def observation(presets: Sequence[str], known: Sequence[str], reasons: Mapping[str, str]) -> Check:
    """Accept the name of a preset, or a list of sensors: names, or dicts with a name and parameters.

    :param presets: names of lists of sensors
    :param known: names of sensors
    :param reasons: constraints for other presets that the control does not have
    """

    def check(value: Any) -> str | list[Any]:
        if isinstance(value, str) and value in presets:
            return value
        if isinstance(value, str) and value in reasons:
            raise Refused(reasons[value])
        if not isinstance(value, list | tuple) or not value:
            raise Refused(f"{' or '.join(map(repr, presets))}, or a list of some of {', '.join(known)}")
        entries = [_sensor(entry, known) for entry in value]
        names = [entry if isinstance(entry, str) else entry["name"] for entry in entries]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise Refused(f"a list with distinct names, without {', '.join(twice)} more than once")
        return entries

    return check


def _sensor(entry: Any, known: Sequence[str]) -> str | dict[str, Any]:
    """Accept the name of a sensor, or a dict with its name, parameters and, for a user's, import path."""
    described = entry if isinstance(entry, Mapping) else {"name": entry}
    name = described.get("name")
    source = described.get("sensor", name)
    if not (isinstance(name, str) and isinstance(source, str)):
        raise Refused(f'a list of names and dicts {{"name": ..., parameter: value}}, without {entry!r}')
    if source not in known and (":" not in source or source == name):
        near = difflib.get_close_matches(source, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(known)}"
        raise Refused(f"a list of known sensors, without {source!r} ({hint})")
    if name in known and source != name:
        raise Refused(f"a list in which other sensors have new names, not {name!r}")
    if not name.isidentifier():
        raise Refused(f"a list in which names are identifiers, not {name!r}")
    if isinstance(entry, str):
        return entry
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(entry), default=_to_list))
    except (TypeError, ValueError):
        raise Refused(f"a list in which parameters are JSON values, without {entry!r}") from None
    return plain


def _to_list(value: Any) -> Any:
    """Return NumPy's arrays and numbers as Python's."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not a JSON value")
