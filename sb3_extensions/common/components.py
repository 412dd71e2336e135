"""Components from Python objects or from YAML, and checks of arguments."""

from collections.abc import Mapping
from typing import TypeVar

Component = TypeVar("Component")


def make_component(parameter: str, spec: object, classes: Mapping[str, type[Component]]) -> Component | None:
    """
    Create a component from its specification.

    :param parameter: name of the parameter, for messages
    :param spec: a component, None, a name (``"drq"``), or a name with arguments (``{"rad": {"size": 64}}``)
    :param classes: classes by name
    :raises ValueError: if the specification is something else
    """
    if spec is None or isinstance(spec, tuple(classes.values())):
        return spec  # type: ignore[return-value]
    named = {spec: None} if isinstance(spec, str) else spec
    if not isinstance(named, Mapping) or len(named) != 1 or not named.keys() <= classes.keys():
        raise ValueError(
            f"{parameter} must be None, one of {', '.join(classes)}, or one of them with its arguments, "
            f"got {spec!r}"
        )
    [(name, arguments)] = named.items()
    try:
        return classes[name](**(arguments or {}))
    except TypeError as error:
        raise ValueError(f"{parameter} must have valid arguments, got {spec!r}: {error}") from error


def check_fraction(**arguments: float) -> None:
    """Raise a ValueError that names the argument if a value is not in [0, 1]."""
    for name, value in arguments.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be between 0 and 1, got {value}")


def check_positive(**arguments: float) -> None:
    """Raise a ValueError that names the argument if a value is not positive."""
    for name, value in arguments.items():
        if value <= 0:
            raise ValueError(f"{name} must be positive, got {value}")


def check_not_negative(**arguments: float) -> None:
    """Raise a ValueError that names the argument if a value is negative."""
    for name, value in arguments.items():
        if value < 0:
            raise ValueError(f"{name} must not be negative, got {value}")
