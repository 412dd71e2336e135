"""Components from Python objects or from YAML, and checks of arguments."""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from numbers import Integral, Real
from typing import Any, TypeVar

Component = TypeVar("Component")


def make_components(
    parameter: str, spec: Any, classes: Mapping[str, Callable[..., Component]]
) -> list[Component]:
    """
    Create components from their specification, in the order of their classes.

    :param parameter: name of the parameter, for messages
    :param spec: None, a name (``"drq"``), or names with arguments (``{"rad": {"size": 64}}``)
    :param classes: classes by name
    :raises ValueError: if the specification is something else
    """
    named = {spec: None} if isinstance(spec, str) else {} if spec is None else spec
    if not isinstance(named, Mapping) or not named.keys() <= classes.keys():
        raise ValueError(
            f"{parameter} must be None, one of {', '.join(classes)}, or names with arguments, got {spec!r}"
        )
    try:
        return [make(**(named[name] or {})) for name, make in classes.items() if name in named]
    except TypeError as error:
        raise ValueError(f"{parameter} must have valid arguments, got {spec!r}: {error}") from error


def check_fraction(**arguments: float) -> None:
    """Raise a ValueError that names the argument if a value is not a number in [0, 1]."""
    _check("a number from 0 to 1", lambda value: 0 <= value <= 1, arguments)


def check_positive(**arguments: float) -> None:
    """Raise a ValueError that names the argument if a value is not a positive number."""
    _check("a positive number", lambda value: value > 0, arguments)


def check_not_negative(**arguments: float) -> None:
    """Raise a ValueError that names the argument if a value is not a number of at least 0."""
    _check("a number of at least 0", lambda value: value >= 0, arguments)


def check_integer(least: int, **arguments: int) -> None:
    """Raise a ValueError that names the argument if a value is not an integer of at least ``least``."""
    _check(f"an integer of at least {least}", lambda value: value >= least, arguments, Integral)


def _check(
    must: str, is_valid: Callable[[Any], bool], arguments: Mapping[str, Any], kind: type[Any] = Real
) -> None:
    for name, value in arguments.items():
        if not (isinstance(value, kind) and is_valid(value)):
            raise ValueError(f"{name} must be {must}, got {value!r}")


def _number(text: str) -> float:
    with suppress(ValueError):
        return float(text)
    return math.nan


ENTROPY: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "ent_coef": (
        "'auto', 'auto_NUMBER' or a number of at least 0",
        lambda value: value == "auto" or 0 <= _number(str(value).removeprefix("auto_")) < math.inf,
    ),
    "target_entropy": (
        "'auto' or a number",
        lambda value: value == "auto" or math.isfinite(_number(str(value))),
    ),
}
"""Description and check of valid values of SAC's arguments about entropy, by name."""


def check_entropy(**arguments: Any) -> None:
    """Raise a ValueError that names the argument if a value is invalid, see :data:`ENTROPY`."""
    for name, value in arguments.items():
        _check(*ENTROPY[name], {name: value}, object)
