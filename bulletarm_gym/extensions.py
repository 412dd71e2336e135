"""What users add: robots, objects, surfaces, sensors and controls by name, and all of theirs by import path.

A thing is stored as ``"module:name"``, so that a worker process, however it is started, finds it by importing
the user's module. What has no such path (a lambda, something local or of ``__main__``) is refused.
"""

import importlib
import sys
from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any, TypeVar

from bulletarm_gym.config import CLOSE_LOOP, LEVEL, OPEN_LOOP, ROBOTS, SENSORS, SLOPING
from bulletarm_gym.inheritance import announce, announced

OBJECTS = ("robot", "reward")
"""Parameters that may be objects of the user's."""
OBJECT_KINDS = (
    *(
        "bottle_tray",
        "bowl",
        "brick",
        "cube",
        "cylinder",
        "flat_block",
        "new_tube_box",
        "packing_bin",
        "pallet",
    ),
    *("palletizing_box", "roof", "swab", "test_area", "triangle", "tube", "used_tube", "used_tube_box"),
    *(f"bottle_{number}" for number in range(8)),
    *(f"improvise_block_{number}" for number in range(19)),
    *(f"packing_block_{number}" for number in range(7)),
)
"""Our objects by name; users register more."""
ROBOT_PATHS: dict[str, str] = announced("robot")
"""Import paths of the users' arms, by name."""
OBJECT_PATHS: dict[str, str] = announced("object")
"""Import paths of the users' objects, by name."""
SENSOR_PATHS: dict[str, str] = announced("sensor")
"""Import paths of the users' sensors, by name."""
SURFACE_PATHS: dict[str, str] = announced("surface")
"""Import paths of the users' surfaces, by name."""
CONTROL_PATHS: dict[str, str] = announced("control")
"""Import paths of the users' controls, by name."""
TABLES = {"robot": ROBOT_PATHS, "surface": SURFACE_PATHS, "control": CONTROL_PATHS}
"""What stands in a recipe or among the parameters by its name."""

Kind = TypeVar("Kind")


def register_robot(name: str, model: Any) -> None:
    """Make an arm available as ``robot=name``.

    :param name: a new one
    :param model: a function without arguments that returns a :class:`~bulletarm_gym.robots.RobotModel`, or
        the path ``"module:name"`` of such a function or of a model
    :raises ValueError: the name is taken or no identifier, or the model has no import path
    """
    _store(ROBOT_PATHS, "robot", name, model, ROBOTS)


def register_object(name: str, make: Any) -> None:
    """Make a kind of object available to tasks as ``objects.create(name, ...)``.

    :param name: a new one
    :param make: ``make(name, scale)`` returns a :class:`~bulletarm_gym.objects.BodySpec`; a function, or the
        path ``"module:name"`` of one
    :raises ValueError: the name is taken or no identifier, or the function has no import path
    """
    _store(OBJECT_PATHS, "object", name, make, OBJECT_KINDS)


def register_surface(name: str, surface: Any) -> None:
    """Make ground available as ``surface=name``, and to :func:`bulletarm_gym.register_task`.

    :param name: a new one
    :param surface: a subclass of :class:`~bulletarm_gym.surfaces.Surface` that can be imported from a module,
        or its path ``"module:Class"``
    :raises ValueError: the name is taken or no identifier, or the class has no import path
    """
    _store(SURFACE_PATHS, "surface", name, surface, (*LEVEL, *SLOPING))


def register_sensor(name: str, sensor: Any) -> None:
    """Make a sensor available in the lists that ``observation`` takes.

    :param name: a new one
    :param sensor: a subclass of :class:`~bulletarm_gym.observations.Sensor` that can be imported from a
        module, or its path ``"module:Class"``
    :raises ValueError: the name is taken or no identifier, or the class has no import path
    """
    _store(SENSOR_PATHS, "sensor", name, sensor, SENSORS)


def register_control(name: str, control: Any) -> None:
    """Make a way to command the arm available as ``control=name`` and to :func:`bulletarm_gym.register_task`.

    :param name: a new one
    :param control: a subclass of :class:`~bulletarm_gym.control.Control` that can be imported from a module,
        or its path ``"module:Class"``
    :raises ValueError: the name is taken or no identifier, or the class has no import path
    """
    _store(CONTROL_PATHS, "control", name, control, (CLOSE_LOOP, OPEN_LOOP))


def import_path(thing: Any, what: str) -> str:
    """Return the path ``"module:name"`` under which another process finds a class or function.

    :param what: what it is, for the error
    :raises ValueError: there is no such path, with the reason
    """
    if isinstance(thing, str):
        load(thing)
        return thing
    module, name = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    if module is None or name is None:
        raise ValueError(f"{what}: {thing!r} is neither a class nor a function nor a path 'module:name'")
    if "<lambda>" in name:
        raise ValueError(f"{what}: a lambda has no name that a worker process could import it by")
    if "<locals>" in name:
        raise ValueError(f"{what}: {name} is local to a function; define it at the top level of a module")
    if module == "__main__":
        file = getattr(sys.modules["__main__"], "__file__", None) or "the interactive session"
        raise ValueError(
            f"{what}: {name} is defined in __main__ ({file}), which worker processes do not import; "
            "put it in a module of its own and import it"
        )
    path = f"{module}:{name}"
    if load(path) is not thing:
        raise ValueError(f"{what}: importing {path!r} gives something else")
    return path


def load(path: str) -> Any:
    """Import ``"module:name"``.

    :raises ValueError: there is no such module or name
    """
    module, _, name = path.partition(":")
    try:
        found = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{path!r} cannot be imported: {error}") from error
    return found


def produce(source: Any, kind: type[Any]) -> Any:
    """Return a thing of a kind.

    :param source: the thing, the function that makes it, or the import path of either
    :raises ValueError: it is neither
    """
    found = load(source) if isinstance(source, str) else source
    made = found() if callable(found) and not isinstance(found, kind) else found
    if not isinstance(made, kind):
        raise ValueError(f"{source!r} is a {type(made).__name__}, not a {kind.__name__}")
    return made


def find_class(
    what: str, name: Any, ours: Mapping[str, type[Kind]], paths: Mapping[str, str], kind: type[Any]
) -> type[Kind]:
    """Return a class by its name, ours or a user's, or by its import path.

    :param what: what it is, for the error
    :raises ValueError: there is no such class, or it is none of this kind
    """
    if name in ours:
        return ours[name]
    path = paths.get(name, name)
    if not isinstance(path, str) or ":" not in path:
        known = ", ".join(repr(other) for other in (*ours, *paths))
        names = f"one of {known}, or " if known else ""
        raise ValueError(f"{what}: got {name!r}, takes {names}'module:Class' of your own")
    try:
        found: type[Kind] = load(path)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"{what}: {path} is no subclass of {kind.__name__}")
    return found


def by_path(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's parameters with import paths in place of what can be imported.

    That is names of users' arms, surfaces, controls, sensors and objects, and functions that make an arm or
    tell the reward; those that have no path (a lambda, one of a notebook) stay as they are.
    """
    found = dict(parameters)
    for name in OBJECTS:
        if callable(found.get(name)):
            with suppress(ValueError):
                found[name] = import_path(found[name], name)
    for name, table in TABLES.items():
        if isinstance(found.get(name), str):
            found[name] = table.get(found[name], found[name])
    if isinstance(found.get("object_set"), list | tuple):
        found["object_set"] = [OBJECT_PATHS.get(kind, kind) for kind in found["object_set"]]
    if isinstance(found.get("observation"), list | tuple):
        found["observation"] = [_sensor_by_path(entry) for entry in found["observation"]]
    return found


def _sensor_by_path(entry: Any) -> Any:
    """Return an entry of a list of sensors with the import path of a user's."""
    described = {"name": entry} if isinstance(entry, str) else entry
    if not isinstance(described, Mapping):
        return entry
    source = described.get("sensor", described.get("name"))
    path = SENSOR_PATHS.get(source) if isinstance(source, str) else None
    return entry if path is None else {**described, "sensor": path}


def _store(table: dict[str, str], what: str, name: str, thing: Any, ours: Collection[str] = ()) -> None:
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"{what}: the name {name!r} is no identifier")
    if name in ours:
        raise ValueError(f"{what}: the name {name!r} is one of ours")
    path = import_path(thing, f"{what} {name!r}")
    if table.setdefault(name, path) != path:
        raise ValueError(f"{what}: the name {name!r} is taken by {table[name]}")
    announce(what, name, path)
