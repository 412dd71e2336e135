"""Conversion of the values of a robot model, with errors that contain the parameter and the value."""

import math
from collections.abc import Callable
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

Converter = Callable[[Any], Any] | type[Any]
"""Class of the value, or function that converts the value or raises TypeError or ValueError."""


def convert(name: str, value: Any, must: str, converter: Converter) -> Any:
    """Return the converted value of a parameter.

    :param must: description of the accepted values
    :raises ValueError: the value cannot be converted
    """
    try:
        if not isinstance(converter, type):
            return converter(value)
        if isinstance(value, converter):
            return value
        raise TypeError
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be {must}, got {value!r}") from None


def convert_fields(model: Any, prefix: str, fields: dict[str, tuple[str, Converter]]) -> None:
    """Convert the fields of a frozen dataclass.

    :param prefix: text before the name of a field in messages
    :param fields: description of the accepted values and converter of each field
    :raises ValueError: a value cannot be converted
    """
    for name, (must, converter) in fields.items():
        object.__setattr__(model, name, convert(prefix + name, getattr(model, name), must, converter))


def check_element(name: str, value: Any) -> None:
    """Raise ValueError if a value is not the root element of a URDF."""
    if not (isinstance(value, Element) and value.tag == "robot"):
        got = f"<{value.tag}>" if isinstance(value, Element) else type(value).__name__
        raise ValueError(f"{name} must be the element <robot> of a URDF, got {got}. Use read_urdf().")


def function(value: Any) -> Any:
    """Return a function."""
    if not callable(value):
        raise TypeError
    return value


def number(value: Any, low: float = -math.inf) -> float:
    """Convert a finite number of at least ``low``."""
    if isinstance(value, bool | str) or not math.isfinite(value) or value < low:
        raise ValueError
    return float(value)


def positive(value: Any) -> float:
    """Convert a positive, finite number."""
    return number(value, math.ulp(0.0))


def numbers(value: Any, count: int | None = None, low: float = -math.inf) -> tuple[float, ...]:
    """Convert a sequence of finite numbers of at least ``low``, of any length without ``count``."""
    found = tuple(number(one, low) for one in value)
    if len(found) != (count or len(found)):
        raise ValueError
    return found


def names(value: Any, count: int | None = None) -> tuple[str, ...]:
    """Convert a list or tuple of names, at least one without ``count``."""
    is_list = isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
    if not is_list or len(value) != (count or max(len(value), 1)):
        raise ValueError
    return tuple(value)


def torques(value: Any) -> float | tuple[float, ...]:
    """Convert a positive number or a sequence of positive numbers."""
    return positive(value) if np.ndim(value) == 0 else tuple(map(positive, value))
