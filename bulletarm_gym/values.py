"""What a value must be, for a parameter to take it."""

import difflib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

Check = Callable[[Any], Any]
"""Returns a value as it is kept, or raises :class:`Refused`."""

SMALLEST_WORKSPACE = 0.04
"""Smallest side (m) of a workspace: room for a cube of 1.5 cm."""
ROUNDING = 1e-9
"""What differences of decimal fractions may be off by (m)."""
LARGEST_SCALE = 2.0
"""A cube twice the nominal size (10 cm) no longer fits any gripper."""
RENDER_SIZES = (16, 4096)
"""Smallest and largest side (pixels) of rendered images."""


class Refused(Exception):
    """Carries what a parameter takes to where its name is known."""


def check_argument(name: str, value: Any, check: Check) -> Any:
    """Return an argument of a function as a check keeps it.

    :raises ValueError: the check refuses it
    """
    try:
        return check(value)
    except Refused as refused:
        raise ValueError(f"{name} must be {refused}, got {value!r}") from None


def mapping(value: Any) -> Mapping[str, Any]:
    """Ask for a mapping of names to values."""
    if not isinstance(value, Mapping):
        raise Refused("a dict")
    return value


def choice(*choices: Any) -> Check:
    """Ask for one of some values, of just that type."""

    def check(value: Any) -> Any:
        plain = value.item() if isinstance(value, np.generic) else value
        if not any(type(plain) is type(known) and plain == known for known in choices):
            raise Refused("one of " + ", ".join(map(repr, choices)))
        return plain

    return check


def robot(names: Sequence[str]) -> Check:
    """Ask for the name of an arm, or the import path of one."""

    def check(value: Any) -> str:
        if value in names or (isinstance(value, str) and ":" in value):
            return str(value)
        raise Refused("one of " + ", ".join(repr(name) for name in names) + ", or 'module:name' of your own")

    return check


def integer(low: int, high: int | None = None) -> Check:
    """Ask for an integer within limits, both included."""

    def check(value: Any) -> int:
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or value < low or (high is not None and value > high):
            raise Refused(f"an integer of at least {low}" + (f" and at most {high}" if high else ""))
        return int(value)

    return check


def positive(value: Any) -> float:
    """Require a positive, finite number."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not 0.0 < float(value) < math.inf:
        raise Refused("a positive number of metres")
    return float(value)


def no_lift_height(default: float) -> Check:
    """Require the default of a parameter that the task does not use."""

    def check(value: Any) -> float:
        if positive(value) != default:
            raise Refused(f"{default:g} with this task: its goal is not to lift an object")
        return default

    return check


def tray(choices: Sequence[bool], reason: str) -> Check:
    """Require one of the values of ``close_loop_tray`` that a task has.

    :param reason: why the task has one value only
    """

    def check(value: Any) -> bool:
        if len(choices) == 1 and value not in choices:
            raise Refused(f"{choices[0]} with this task: {reason}")
        return boolean(value)

    return check


def number(low: float, high: float, unit: str) -> Check:
    """Require a number within limits, both included.

    :param unit: of the number, in the plural
    """

    def check(value: Any) -> float:
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not is_number or not low <= float(value) <= high:
            raise Refused(f"a number of {unit} from {low:g} to {high:g}")
        return float(value)

    return check


def point(value: Any) -> list[float]:
    """Require the coordinates of a point."""
    found: list[float] = _numbers(value, (3,), "[x, y, z] in metres")
    return found


def render_size(value: Any) -> list[int]:
    """Require the size of rendered images; a square may be one integer."""
    pair = [value, value] if isinstance(value, int | np.integer) else value
    pixels = integer(*RENDER_SIZES)
    try:
        width, height = map(pixels, pair)
    except (Refused, TypeError, ValueError):
        low, high = RENDER_SIZES
        raise Refused(f"a number of pixels or [width, height], each from {low} to {high}") from None
    return [width, height]


def camera(value: Any) -> dict[str, Any]:
    """Require a camera: some of its position, target and field of view."""
    checks: dict[str, Check] = {"position": point, "target": point, "fov": FIELD_OF_VIEW}
    if not isinstance(value, Mapping) or not value.keys() <= checks.keys():
        raise Refused(f"None or a dict with some of {', '.join(map(repr, checks))}")
    try:
        return {name: checks[name](entry) for name, entry in value.items()}
    except Refused as refused:
        raise Refused(f"a dict in which each of {', '.join(value)} is valid: {refused}") from None


def optional(inner: Check) -> Check:
    """Allow None besides what a check asks for."""
    return lambda value: None if value is None else inner(value)


def boolean(value: Any) -> bool:
    """Ask for True or False."""
    if not isinstance(value, bool | np.bool_):
        raise Refused("True or False")
    return bool(value)


def object_set(value: Any) -> str | list[str]:
    """Ask for a folder that exists, or the names of kinds; return the absolute path of a folder."""
    if isinstance(value, list | tuple) and value and all(isinstance(kind, str) for kind in value):
        return [str(kind) for kind in value]
    if not isinstance(value, str | os.PathLike):
        raise Refused("None, a folder of OBJ, STL or URDF files, or a list of kinds of objects")
    if not os.path.isdir(value):
        where = "" if os.path.isabs(value) else f" in the working directory {os.getcwd()}"
        raise Refused(f"None, an existing folder{where} or a list of kinds of objects")
    return os.path.abspath(os.fspath(value))


def no_object_set(value: Any) -> None:
    """Refuse other objects."""
    if value is not None:
        raise Refused("None with this task: its objects are its own")


def import_path(value: Any) -> str:
    """Ask for an import path."""
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise Refused('None or "module:function"')
    return str(value)


def observation(presets: Sequence[str], known: Sequence[str], reasons: Mapping[str, str]) -> Check:
    """Ask for the name of a preset or a list of sensors, each a name or an object with one.

    :param presets: names that stand for lists
    :param known: names of sensors
    :param reasons: why some presets cannot be had
    """

    def check(value: Any) -> str | list[Any]:
        if isinstance(value, str) and value in reasons:
            raise Refused(reasons[value])
        if isinstance(value, str) and value in presets:
            return value
        if not isinstance(value, list | tuple) or not value:
            raise Refused(f"{' or '.join(map(repr, presets))}, or a list of some of {', '.join(known)}")
        entries = [_sensor(entry, known) for entry in value]
        names = [entry if isinstance(entry, str) else entry["name"] for entry in entries]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise Refused(f"each name once, not {', '.join(twice)} more often")
        return entries

    return check


def _sensor(entry: Any, known: Sequence[str]) -> str | dict[str, Any]:
    """Ask for a sensor by its name, or an object with its name and parameters; a user's has its path."""
    described = {"name": entry} if isinstance(entry, str) else entry
    name = described.get("name") if isinstance(described, Mapping) else None
    source = described.get("sensor", name) if isinstance(described, Mapping) else None
    if not (isinstance(name, str) and isinstance(source, str)):
        raise Refused(f'sensors by name, or {{"name": ..., its parameters}}, not {entry!r}')
    if source not in known and (":" not in source or source == name):
        near = difflib.get_close_matches(source, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(known)}"
        raise Refused(f"sensors that there are: no {source!r}, {hint}")
    if name in known and source != name:
        raise Refused(f"names of your own for other sensors: {name!r} is not {source!r}")
    if not name.isidentifier():
        raise Refused(f"names that are identifiers, not {name!r}")
    if isinstance(entry, str):
        return entry
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(entry), default=_listed))
    except (TypeError, ValueError):
        raise Refused(f"parameters that are JSON values, not {entry!r}") from None
    return plain


def _listed(value: Any) -> Any:
    """Return NumPy's arrays and numbers as Python's."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON value")


def sequence(known: Sequence[str]) -> Check:
    """Ask for one of some words, its characters in any order."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or sorted(value) not in [sorted(word) for word in known]:
            raise Refused(
                f"{', '.join(map(repr, known[:-1]))} or {known[-1]!r}, their characters in any order"
            )
        return value

    return check


def _numbers(value: Any, shape: tuple[int, ...], takes: str) -> Any:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise Refused(takes) from None
    if array.shape != shape or not np.isfinite(array).all():
        raise Refused(takes)
    return array.tolist()


def workspace(value: Any) -> list[list[float]]:
    """Ask for limits along x, y and z."""
    takes = (
        "[[x low, x high], [y low, y high], [z low, z high]] in metres, square in x and y with sides "
        f"of at least {SMALLEST_WORKSPACE:g}, z low not below 0"
    )
    limits: list[list[float]] = _numbers(value, (3, 2), takes)
    x, y, z = (high - low for low, high in limits)
    square = math.isclose(x, y, abs_tol=ROUNDING)
    if not (x >= SMALLEST_WORKSPACE - ROUNDING and square and z > 0.0 and limits[2][0] >= 0.0):
        raise Refused(takes)
    return limits


def scale_range(value: Any) -> list[float]:
    """Ask for a factor or a range of them."""
    takes = f"a positive number or [low, high], at most {LARGEST_SCALE}"
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    pair = [value, value] if is_number else value
    limits: list[float] = _numbers(pair, (2,), takes)
    if not 0.0 < limits[0] <= limits[1] <= LARGEST_SCALE:
        raise Refused(takes)
    return limits


FIELD_OF_VIEW = number(1.0, 170.0, "degrees")
"""Check of a camera's vertical field of view."""
