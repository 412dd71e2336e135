"""States as plain JSON, which any program can read; loading one imports and runs nothing.

A JSON array is a tuple. Other values are objects with one key: ``{"list": [...]}``,
``{"dict": [[key, value], ...]}``, ``{"bytes": "base64"}``, or the name and the fields of a dataclass or named
tuple, ``{"Pose": [[x, y, z], [x, y, z, w]]}``. The names are the keys of
:data:`~bulletarm_gym.scene.state.STATE_TYPES`.
"""

import base64
import json
from typing import Any

import numpy as np

from bulletarm_gym.scene.state import STATE_TYPES, field_names


def dumps(value: Any) -> str:
    """Return numbers, text, bytes, None, tuples, lists, dicts and declared types of them as JSON."""
    return json.dumps(_encoded(value), separators=(",", ":"))


def loads(text: str | bytes) -> Any:
    """Return exactly the value that :func:`dumps` has written, or raise ValueError."""
    try:
        return _decoded(json.loads(text))
    except TypeError as error:
        raise ValueError(f"text must come from dumps(): {error}") from error


def _encoded(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    kind = type(value)
    if kind is tuple:
        return list(map(_encoded, value))
    if STATE_TYPES.get(kind.__name__) is not kind:
        raise ValueError(
            f"state must consist of plain values and declared types, got a {kind.__name__}: {value!r}. "
            "Add dataclasses and named tuples to the task's memory_types."
        )
    if kind is bytes:
        return {"bytes": base64.b64encode(value).decode()}
    if kind is dict:
        return {"dict": [list(map(_encoded, item)) for item in value.items()]}
    fields = value if kind is list else [getattr(value, name) for name in field_names(kind)]
    return {kind.__name__: list(map(_encoded, fields))}


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_decoded, value))
    if not isinstance(value, dict):
        return value
    ((name, content),) = value.items()
    kind = STATE_TYPES.get(name)
    if kind is None:
        raise ValueError(
            f"state type must be one of {', '.join(STATE_TYPES)}, got {name!r}. "
            "Import the module of the task that declares it."
        )
    if kind is bytes:
        return base64.b64decode(content)
    values = _decoded(content)
    if kind in (list, dict):
        return kind(values)
    names = field_names(kind)
    if len(values) != len(names):
        raise TypeError(f"{name} has {len(names)} fields, got {len(values)}")
    return kind(**dict(zip(names, values, strict=True)))
