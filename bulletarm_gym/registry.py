"""Tasks, robots, objects, surfaces, sensors and controls by name, and the table of environment ids."""

import importlib
import json
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from operator import attrgetter
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from bulletarm_gym import config_checks as checks
from bulletarm_gym.config_checks import Check, ParameterError, Refused, check_argument

VARIABLE = "BULLETARM_GYM_REGISTERED"
"""Environment variable in which a process publishes its registrations, as JSON, for child processes."""
LIMITS = "max_steps"
"""Key in it of the default ``max_steps`` of registered tasks, by id."""


def published() -> dict[str, dict[str, Any]]:
    """Return the registrations of this process and of the process that started it, by kind and name."""
    with suppress(ValueError):  # another program may have set the variable
        if isinstance(found := json.loads(os.environ.get(VARIABLE, "{}")), dict):
            return found
    return {}


def _publish(kind: str, name: str, registered: Any) -> None:
    everything = published()
    everything.setdefault(kind, {})[name] = registered
    os.environ[VARIABLE] = json.dumps(everything)


def load(path: str) -> Any:
    """Import ``"module:attribute"``."""
    module, _, name = path.partition(":")
    try:
        return attrgetter(name)(importlib.import_module(module))
    except (ImportError, AttributeError, ValueError) as error:
        advice = ". Define it in a module that this process can import" if module == "__main__" else ""
        raise ValueError(f"{path!r} cannot be imported: {error}{advice}") from error


def import_path(component: Any) -> str:
    """Return the path ``"module:attribute"`` under which a class or function can be imported.

    A path in ``__main__``, such as that of a class in a notebook, is valid in this process only.

    :raises ValueError: no such path exists, with the reason
    """
    if isinstance(component, str):
        load(component)
        return component
    module, name = (getattr(component, key, None) for key in ("__module__", "__qualname__"))
    if module is None or name is None:
        raise ParameterError.of("component", component, "a class, a function or a path 'module:attribute'")
    if "<lambda>" in name or "<locals>" in name:
        reason = "a lambda" if "<lambda>" in name else "local to a function"
        raise ValueError(f"{name} cannot be imported: it is {reason}. Define it at the top level of a module")
    path = f"{module}:{name}"
    if load(path) is not component:
        raise ValueError(f"importing {path!r} returns another object")
    return path


def registered_path(component: Any) -> str:
    """Return the import path of a component to register, see :func:`import_path`.

    :raises ValueError: no such path exists, or it is in the script that runs, except in interactive sessions
    """
    path = import_path(component)
    if path.startswith("__main__:") and not hasattr(sys, "ps1"):
        raise ValueError(f"{path!r} cannot be imported by other processes. Move it to a module")
    return path


NAME = checks.rule("an identifier", str.isidentifier)
"""Check of names of components."""


@dataclass
class Registry:
    """Components of one kind, found by name or by import path ``"module:attribute"``.

    A registered component is kept as its import path, so that worker processes can import it.

    :param kind: name of the kind, the parameter of environments that selects a component
    :param check: check of an imported object, which returns the component
    :param source: import path, in this package, of the built-in components by name; ``""`` if there are none
    """

    kind: str
    check: Check
    source: str = ""
    paths: dict[str, str] = field(init=False)
    """Import paths of the registered components, by name."""

    def __post_init__(self) -> None:
        """Begin with the registrations of the process that started this one."""
        self.paths = published().get(self.kind, {})

    @cached_property
    def builtin(self) -> Mapping[str, Any]:
        """The components of this package, by name."""
        found: Mapping[str, Any] = load(f"bulletarm_gym.{self.source}") if self.source else {}
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all components, the built-in ones first."""
        return (*self.builtin, *self.paths)

    def register(self, name: str, component: Any) -> None:
        """Add a component.

        :param name: identifier
        :param component: class or function at the top level of a module, or its import path
        :raises ValueError: the name is not an identifier or is in use, or the component has no import path
        """
        check_argument("name", name, NAME)
        if name in self.builtin:
            raise ValueError(f"name must be unused, got {name!r}, a built-in {self.kind}")
        path = registered_path(component)
        if self.paths.setdefault(name, path) != path:
            raise ValueError(f"name must be unused, got {name!r}, the name of {self.paths[name]}")
        _publish(self.kind, name, path)

    def path(self, name: Any) -> Any:
        """Return the import path of a registered component; other values are returned as they are."""
        return self.paths.get(name, name) if isinstance(name, str) else name

    def find(self, source: Any, parameter: str | None = None) -> Any:
        """Return a component by its name or import path.

        :param parameter: name of the parameter in errors, by default the kind
        """
        if isinstance(source, str) and source in self.builtin:
            return self.builtin[source]
        path, names = self.path(source), "".join(f"{name!r}, " for name in self.names)
        try:
            if not (isinstance(path, str) and ":" in path):
                raise ValueError
            found = load(path)
        except ValueError as error:
            must = f"one of {names}or 'module:attribute'" if names else "'module:attribute'"
            raise ParameterError.of(parameter or self.kind, source, must, str(error)) from error
        try:
            return self.check(found)
        except Refused as refused:
            raise ParameterError.of(parameter or self.kind, source, str(refused)) from refused


def _subclass(path: str, found: Any) -> Any:
    """Return a class if it is a subclass of the class at an import path in this package."""
    base = load(f"bulletarm_gym.{path}")
    if not (isinstance(found, type) and issubclass(found, base)):
        raise Refused(f"a subclass of {base.__name__}")
    return found


def _robot_model(found: Any) -> Any:
    """Return a robot model, or the model that a function without arguments returns."""
    try:
        model = found() if callable(found) else found
    except TypeError as error:
        raise Refused(f"a RobotModel or a function without arguments ({error})") from error
    if not isinstance(model, load("bulletarm_gym.robots.model:RobotModel")):
        raise Refused(f"a RobotModel or a function that returns one, not a {type(model).__name__}")
    return model


TASKS = Registry("task", partial(_subclass, "tasks:Task"))
REWARDS = Registry("reward", checks.function)
ROBOTS = Registry("robot", _robot_model, "robots:ROBOTS")
OBJECTS = Registry("object", checks.function, "objects.catalogue:KINDS")
SURFACES = Registry("surface", partial(_subclass, "surfaces:Surface"), "surfaces:SURFACES")
SENSORS = Registry("sensor", partial(_subclass, "observations:Sensor"), "observations.observer:SENSORS")
CONTROLS = Registry("control", partial(_subclass, "control:Control"), "control:CONTROLS")
KINDS = checks.rule(
    "a tuple of 'close_loop' and 'open_loop'",
    {"close_loop", "open_loop"}.issuperset,
    checks.instances(str, "kinds", can_be_empty=False),
)
"""Check of the kinds of controls of a task."""

register_robot = ROBOTS.register
"""Make a robot available as ``robot=name``.

The component is a function without arguments that returns a :class:`~bulletarm_gym.robots.RobotModel`, or the
import path of such a function or of a model. Raises as :meth:`Registry.register`.
"""
register_object = OBJECTS.register
"""Make a kind of object available as ``objects.create(name, ...)`` and in ``object_set``.

The component is a function ``make(name, scale)`` that returns a :class:`~bulletarm_gym.objects.BodySpec`.
"""
register_surface = SURFACES.register
"""Make a subclass of :class:`~bulletarm_gym.surfaces.Surface` available as ``surface=name``."""
register_sensor = SENSORS.register
"""Make a subclass of :class:`~bulletarm_gym.observations.Sensor` available in lists of ``observation``."""
register_control = CONTROLS.register
"""Make a subclass of :class:`~bulletarm_gym.control.Control` available as ``control=name``."""


def find_combination(task: Any, control: Any) -> tuple[Any, Any]:
    """Return the classes of a task and a control, by name or import path.

    :raises ParameterError: they cannot be combined, or an attribute of a class is invalid
    """
    task_type, control_type = TASKS.find(task), CONTROLS.find(control)
    defaults: type = load("bulletarm_gym.config:TaskDefaults")
    for owner, name, check in (
        (task_type, "defaults", checks.instance(defaults)),
        (task_type, "controls", KINDS),
        (control_type, "kind", checks.instance(str)),
        (control_type, "sequences", checks.instances(str, "texts")),
    ):
        check_argument(f"{name} of {owner.__name__}", getattr(owner, name, None), check)
    if control_type.kind not in task_type.controls:
        must = f"a control of the kinds {', '.join(task_type.controls)} with {task_type.__name__}"
        raise ParameterError.of("control", control, must)
    return task_type, control_type


def by_path(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of an environment with import paths instead of registered names and functions.

    Functions without an import path, such as lambdas, are returned as they are.
    """
    found = dict(parameters)
    for name in ("robot", "reward"):
        if callable(found.get(name)):
            with suppress(ValueError):
                found[name] = import_path(found[name])
    for registry in (ROBOTS, SURFACES, CONTROLS):
        if registry.kind in found:
            found[registry.kind] = registry.path(found[registry.kind])
    for name, convert in (("object_set", OBJECTS.path), ("observation", _sensor_by_path)):
        if (entries := checks.listed(found.get(name))) is not None:
            found[name] = [convert(entry) for entry in entries]
    return found


def _sensor_by_path(entry: Any) -> Any:
    """Return an entry of a list of sensors with the import path of a registered sensor."""
    described = {"name": entry} if isinstance(entry, str) else entry
    if not isinstance(described, Mapping):
        return entry
    source = described.get("sensor", described.get("name"))
    path = SENSORS.path(source)
    return entry if path == source else {**described, "sensor": path}


# Ids

NAMESPACE = "BulletArm"

PAIR = {"num_objects": 2, "object_scale_range": 1.0, "max_steps": 50}
"""Parameters of the paper's closed-loop Block Stacking and House Building: two blocks of 5 cm."""


def _env_id(name: str, control: str, surface: str) -> str:
    """Return an id such as ``"BulletArm/OpenLoopRampBlockStacking-v0"``; ``"flat"`` is not named."""
    words = f"{control}_{'' if surface == 'flat' else surface}".split("_")
    return f"{NAMESPACE}/{''.join(word[:1].upper() + word[1:] for word in words)}{name}-v0"


def _environments(
    tasks: str, control: str, surface: str = "flat", defaults: Mapping[str, Any] | None = None
) -> dict[str, dict[str, Any]]:
    """Return the arguments of the constructor by id.

    :param tasks: words ``module:Class`` in ``bulletarm_gym.tasks``, or ``module:Class:Name`` if the id has
        another name
    :param defaults: JSON values that replace the tasks' defaults of parameters
    """
    shared = {"control": control, "surface": surface, **({"defaults": dict(defaults)} if defaults else {})}
    environments = {}
    for task in tasks.split():
        module, kind, *other = task.split(":")
        path = f"bulletarm_gym.tasks.{module}:{kind}"
        environments[_env_id(other[0] if other else kind, control, surface)] = {"task": path, **shared}
    return environments


HOUSES = (
    "stacking:HouseBuilding1 stacking:HouseBuilding2 stacking:HouseBuilding3 stacking:HouseBuilding4 "
    "stacking:ImproviseHouseBuilding2 stacking:ImproviseHouseBuilding3"
)
STRUCTURES = f"stacking:BlockStacking {HOUSES}"
PACKAGING = "packing:BinPacking packing:BottleArrangement palletizing:BoxPalletizing covid:CovidTest"
BLOCKS = "picking:BlockReaching picking:BlockPicking pushing:BlockPushing pushing:BlockPulling"

PAPER = {
    **_environments(f"{STRUCTURES} {PACKAGING} clutter:OpenLoopObjectGrasping:ObjectGrasping", "open_loop"),
    **_environments(STRUCTURES, "open_loop", "ramp"),
    **_environments("stacking:HouseBuilding4 palletizing:BoxPalletizing", "open_loop", "bump"),
    **_environments(f"{BLOCKS} picking:BlockInBowl", "close_loop"),
    **_environments(
        "stacking:BlockStacking stacking:HouseBuilding1:HouseBuilding", "close_loop", "flat", PAIR
    ),
    **_environments("picking:CornerPicking drawer:DrawerOpening clutter:ObjectGrasping", "close_loop"),
}
"""Environments of the paper: arguments of the constructor by id."""
COMPOSED = {
    **_environments(f"{HOUSES} {PACKAGING}", "close_loop"),
    **_environments("picking:BlockPicking", "close_loop", "ramp"),
    **_environments("picking:BlockPicking picking:BlockInBowl", "close_loop", "bump"),
}
"""Other combinations of the paper's tasks, if the expert succeeds in at least 95 % of episodes."""
OWN = {
    **_environments("sorting:BlockSorting", "open_loop"),
    **_environments("sorting:BlockSorting", "close_loop"),
}
"""Environments that are not in the paper."""
ENVIRONMENTS = {**PAPER, **COMPOSED, **OWN}
MAX_STEPS = {
    **dict.fromkeys(HOUSES.replace("stacking:", "").split(), (10, 100)),
    **{"HouseBuilding4": (20, 200), "BinPacking": (20, 200), "BottleArrangement": (20, 240)},
    **{"BoxPalletizing": (40, 400), "CovidTest": (30, 300), "BlockSorting": (20, 100)},
    "OpenLoopObjectGrasping": (1, 1),
}
"""Default ``max_steps`` of tasks in open and closed loop, if not 10 and 50, for specs before any import."""

PAPER_IDS: tuple[str, ...] = tuple(PAPER)
ENV_IDS: tuple[str, ...] = tuple(ENVIRONMENTS)


def register_all() -> None:
    """Register the ids of the package, and the registrations of the process that started this one."""
    known = published()
    steps = {env_id: _max_steps(kwargs) for env_id, kwargs in ENVIRONMENTS.items()}
    steps |= known.get(LIMITS, {})
    for env_id, kwargs in {**ENVIRONMENTS, **known.get(TASKS.kind, {})}.items():
        if env_id not in gymnasium.registry:
            register(env_id, kwargs, steps.get(env_id))


def _max_steps(kwargs: Mapping[str, Any]) -> int:
    """Return the maximum number of steps of an environment of this package."""
    _, _, task = kwargs["task"].partition(":")
    steps: int = MAX_STEPS.get(task, (10, 50))[kwargs["control"] == "close_loop"]
    return int(kwargs.get("defaults", {}).get("max_steps", steps))


def register_task(name: str, task: Any, control: str = "close_loop", surface: str = "flat") -> str:
    """Register an environment id for a task.

    :param name: name in the id, such as ``"BlockShaking"``
    :param task: subclass of :class:`~bulletarm_gym.tasks.Task`, or its import path
    :param control: name of a built-in or registered control
    :param surface: name of a built-in or registered surface
    :return: the id, such as ``"BulletArm/CloseLoopBlockShaking-v0"``
    :raises ValueError: the name is not an identifier or is in use, the control or surface is unknown, the
        two cannot be combined with the task, or the class has no import path
    """
    check_argument("name", name, NAME)
    for registry, chosen in ((CONTROLS, control), (SURFACES, surface)):
        if chosen not in registry.names:
            raise ParameterError.of(registry.kind, chosen, f"one of {', '.join(map(repr, registry.names))}")
    env_id = _env_id(name, control, surface)
    kwargs = by_path({"task": registered_path(task), "control": control, "surface": surface})
    task_type, control_type = find_combination(kwargs["task"], kwargs["control"])
    config = importlib.import_module("bulletarm_gym.config")  # which imports this module
    components = (control_type.kind, task_type.defaults, kwargs["surface"], control_type.sequences)
    max_steps = config.EnvConfig.of(config.Context(*components), {}).max_steps
    known_spec = gymnasium.registry.get(env_id)
    if known_spec is None:
        register(env_id, kwargs, max_steps)
    elif known_spec.kwargs != kwargs:
        raise ValueError(f"name must be unused, got {name!r}: {env_id} has {known_spec.kwargs}")
    _publish(TASKS.kind, env_id, kwargs)
    _publish(LIMITS, env_id, max_steps)
    return env_id


def register(env_id: str, kwargs: Mapping[str, Any], max_steps: int | None = None) -> None:
    """Register an id with Gymnasium, with arguments of the constructor and its default of ``max_steps``."""
    gymnasium.register(
        env_id,
        entry_point="bulletarm_gym.env:ManipulationEnv",
        max_episode_steps=max_steps,
        kwargs=dict(kwargs),
        additional_wrappers=(time_limit_spec(max_steps),),
    )


def time_limit_spec(known: int | None) -> WrapperSpec:
    """Return the spec of :func:`~bulletarm_gym.wrappers.own_time_limit`."""
    return WrapperSpec("own_time_limit", "bulletarm_gym.wrappers:own_time_limit", {"known": known})
