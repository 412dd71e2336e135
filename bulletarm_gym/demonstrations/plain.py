"""States as plain JSON: read by any program, and run by none, unlike a pickle.

An array of JSON is a tuple, and each other thing an object with one key: ``{"list": [...]}``,
``{"dict": [[key, value], ...]}``, ``{"bytes": "base64"}``, or for a dataclass or named tuple the path of its
class and its values, ``{"bulletarm_gym.geometry:Pose": [[x, y, z], [x, y, z, w]]}``.
"""

import base64
import dataclasses
import json
from typing import Any

import numpy as np

from bulletarm_gym.extensions import import_path, load


def dumps(value: Any) -> str:
    """Return a value as JSON.

    :raises ValueError: something in it is neither a number, text, bytes or None nor a tuple, list, dict,
        named tuple or dataclass of such things
    """
    return json.dumps(_encoded(value), separators=(",", ":"))


def loads(text: str | bytes) -> Any:
    """Return the value that :func:`dumps` has written, exactly.

    :raises ValueError: it has written no such text
    """
    return _decoded(json.loads(text))


def _encoded(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, bytes):
        return {"bytes": base64.b64encode(value).decode()}
    if isinstance(value, dict):
        return {"dict": [[_encoded(key), _encoded(entry)] for key, entry in value.items()]}
    if isinstance(value, list):
        return {"list": [_encoded(entry) for entry in value]}
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return {import_path(type(value), "state"): [_encoded(getattr(value, name)) for name in names]}
    if isinstance(value, tuple):
        values = [_encoded(entry) for entry in value]
        return {import_path(type(value), "state"): values} if hasattr(value, "_fields") else values
    raise ValueError(f"state: {value!r} is a {type(value).__name__}, which is neither plain nor a dataclass")


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_decoded(entry) for entry in value)
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "bytes":
        return base64.b64decode(content)
    values = _decoded(content)
    if kind in ("list", "dict"):
        return {"list": list, "dict": dict}[kind](values)
    made = load(kind)
    if not (isinstance(made, type) and (dataclasses.is_dataclass(made) or hasattr(made, "_fields"))):
        raise ValueError(f"state: {kind} is neither a dataclass nor a named tuple")
    return made(*values)
