"""Checks of the values in the model of an arm."""

import math
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.config_checks import Check, Refused, check_argument


def check_fields(model: Any, prefix: str, checks: dict[str, Check]) -> None:
    """Check the fields of a frozen dataclass and keep them as the checks return them.

    :param prefix: text in front of the name of a field in the message
    :raises ValueError: a check refuses a value
    """
    for name, check in checks.items():
        object.__setattr__(model, name, check_argument(prefix + name, getattr(model, name), check))


def check_element(name: str, value: Any) -> None:
    """Check that a value is a URDF.

    :raises ValueError: it is not the root element of one
    """
    if not (isinstance(value, Element) and value.tag == "robot"):
        got = f"<{value.tag}>" if isinstance(value, Element) else type(value).__name__
        raise ValueError(f"{name} must be the element <robot> of a URDF, got {got}. Use read_urdf().")


def function(value: Any) -> Any:
    """Require a function."""
    if not callable(value):
        raise Refused("a function that returns the URDF")
    return value


def instance(kind: type[Any]) -> Check:
    """Require an object of a class."""

    def check(value: Any) -> Any:
        if not isinstance(value, kind):
            raise Refused(f"a {kind.__name__}")
        return value

    return check


def names(count: int | None = None) -> Check:
    """Require a sequence of names.

    :param count: number of names; any from 1 by default
    """

    def check(value: Any) -> tuple[str, ...]:
        is_list = isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
        if not is_list or len(value) != (count or max(len(value), 1)):
            raise Refused(f"a tuple of {count} names" if count else "a tuple with the name of each joint")
        return tuple(value)

    return check


def numbers(description: str, count: int | None = None, low: float = -math.inf) -> Check:
    """Require a sequence of finite numbers.

    :param description: of the numbers
    :param count: number of values; any by default
    :param low: minimum
    """

    def check(value: Any) -> tuple[float, ...]:
        is_list = isinstance(value, list | tuple | np.ndarray) and all(map(_is_number, value))
        if not is_list or len(value) != (count or len(value)) or any(number < low for number in value):
            raise Refused(description)
        return tuple(float(number) for number in value)

    return check


def finite(value: Any) -> float:
    """Require a finite number."""
    if not _is_number(value):
        raise Refused("a finite number")
    return float(value)


def positive(value: Any) -> float:
    """Require a positive, finite number."""
    if not _is_number(value) or value <= 0.0:
        raise Refused("a positive number")
    return float(value)


def torques(value: Any) -> float | tuple[float, ...]:
    """Require one positive number or a sequence of them."""
    try:
        is_list = isinstance(value, list | tuple | np.ndarray)
        return tuple(map(positive, value)) if is_list else positive(value)
    except Refused:
        raise Refused("a positive number (N m), or a tuple with one for each joint") from None


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return is_number and math.isfinite(value)
