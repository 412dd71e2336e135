"""Checks of combinations of parameters, task and robot, and of the values that a task's methods return."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError, default_home_height
from bulletarm_gym.geometry import Footprint, Pose
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.tasks.task import Task

INFO = frozenset({"is_success", "is_valid", "ignored"})
"""Keys of ``info`` that the environment sets."""
CLEARANCE = 0.001
"""Clearance (m) that the open fingers need around an object."""


def check_scene(config: EnvConfig, default: EnvConfig, scene: Scene, task: Task) -> None:
    """Check that workspace, home height and objects fit the robot.

    :param default: default parameters of the environment
    :raises ParameterError: they do not
    """
    model = scene.robot.model
    if model.jumps_inside(config.workspace):
        base = f"its base at ({model.base.x:g}, {model.base.y:g}) and the line behind it, where it would jump"
        raise ParameterError.of("workspace", config.workspace, f"outside of robot={config.robot!r}: {base}")
    _check_home(config, scene)
    scale = "object_scale_range"
    name = scale if config.object_set is None else "object_set"
    if config.object_set is not None or (task.grasps and getattr(config, scale) != getattr(default, scale)):
        _check_widths(config, scene, name)


def check_heights(config: EnvConfig, default: EnvConfig, task: Task) -> None:
    """Check that the gripper can descend to the objects and lift them within the workspace.

    :param default: default parameters of the environment
    :raises ParameterError: it cannot
    """
    low, high = config.workspace[2]
    smallest = CUBE_SIZE * min(config.scales)
    if high <= task.height:
        names = ["lift_height"] if task.height == config.lift_height else []
        names += ["workspace", "num_objects", "object_scale_range", "workspace"]
        must = f"such that the height to lift objects to, {task.height:.4g} m, is below the top, {high:g} m"
        raise _changed_error(config, default, names, must)
    if config.control == CLOSE_LOOP and low >= smallest:
        must = f"such that the height of objects, {smallest:.4g} m, is above the bottom, {low:g} m"
        names = ["object_scale_range"] if low < CUBE_SIZE * min(default.scales) else []
        raise _changed_error(config, default, [*names, "workspace"], must)


def _changed_error(config: EnvConfig, default: EnvConfig, names: list[str], must: str) -> ParameterError:
    """Return the error of the first parameter that differs from its default, or of the last one."""
    changed = (name for name in names if getattr(config, name) != getattr(default, name))
    name = next(changed, names[-1])
    return ParameterError.of(name, getattr(config, name), must)


def _check_home(config: EnvConfig, scene: Scene) -> None:
    """Check that ``home_height`` is within the workspace and, unless it is the default, above the objects."""
    low, high = config.workspace[2]
    if not low <= config.home_height <= (high if config.control == CLOSE_LOOP else math.inf):
        must = f"within the workspace, from {low:g} to {high:g} m"
        raise ParameterError.of("home_height", config.home_height, must)
    tallest = max((body.spec.extents[2] for item in scene.objects for body in item.bodies), default=0.0)
    if default_home_height(config.control, config.workspace) != config.home_height <= tallest:
        must = f"above {tallest:.4g} m, the height of this task's objects"
        raise ParameterError.of("home_height", config.home_height, must)


def _check_widths(config: EnvConfig, scene: Scene, parameter: str) -> None:
    """Check that the narrowest piece of every loose object fits between the fingers."""
    stroke, origin = scene.robot.model.gripper.stroke, Pose((0.0, 0.0, 0.0))
    for obj in scene.objects:
        pieces = [[piece.mesh.vertices for piece in spec.pieces] for spec in obj.slot.variants]
        width = max(min(Footprint.of(piece, origin).width for piece in body) for body in pieces)
        if obj.spec.mass > 0.0 and width + CLEARANCE > stroke:
            must = f"such that objects fit between the fingers of robot={config.robot!r}, {stroke:g} m apart"
            reason = f"{obj.slot.name} is {width:.4g} m wide"
            raise ParameterError.of(parameter, getattr(config, parameter), must, reason)


def checked_options(options: Mapping[str, Any] | None, task: Task) -> dict[str, Any]:
    """Return the options of a reset, of which ``set_state()`` checks a state.

    :raises ValueError: an option is unknown or next to a state, or the task has no structure to start from
    """
    given = {} if options is None else options
    if isinstance(given, Mapping) and "state" in given:
        if len(given) > 1:
            raise ValueError(f"options must have no others next to 'state', got {sorted(given)}")
        if getattr(given["state"], "ended", False):
            raise ValueError("state must be before the end of its episode, got one after it")
        return dict(given)
    if (
        not isinstance(given, Mapping)
        or not given.keys() <= {"new_scene", "start"}
        or not isinstance(given.get("new_scene", False), bool)
        or given.get("start", "goal") != "goal"
    ):
        must = 'None or a dict with "new_scene": True or False and "start": "goal", or with "state"'
        raise ValueError(f"options must be {must}, got {options!r}")
    if "start" in given and not task.has_goal_structure:
        must = f"without a start, as {type(task).__name__} has no arrange_goal()"
        raise ValueError(f"options must be {must}, got {options!r}")
    return dict(given)


def checked_slots(slots: Any, task: Task) -> Sequence[ObjectSlot]:
    """Return the object slots of a task's ``bodies()``.

    :raises ValueError: they are something else, or two have the same name
    """
    must = f"bodies() of {type(task).__name__} must return"
    if not isinstance(slots, Sequence) or not all(isinstance(slot, ObjectSlot) for slot in slots):
        raise ValueError(f"{must} a list of slots, got {slots!r}")
    names = [slot.name for slot in slots]
    if len(set(names)) < len(names):
        raise ValueError(f"{must} slots with distinct names, got {', '.join(map(repr, names))}")
    return slots


def checked_predicates(predicates: Any, task: Task) -> dict[str, bool]:
    """Return the predicates of a task's ``evaluate()`` as bools.

    :raises ValueError: ``"success"`` is missing, or a name is one of the environment's own
    """
    if not isinstance(predicates, Mapping) or "success" not in predicates or not INFO.isdisjoint(predicates):
        must = f"a dict with 'success' and without {', '.join(map(repr, sorted(INFO)))}"
        raise ValueError(f"evaluate() of {type(task).__name__} must return {must}, got {predicates!r}")
    return {name: bool(value) for name, value in predicates.items()}


def finite_reward(value: Any, reward: Callable[..., Any]) -> float:
    """Return a reward as a number.

    :raises ValueError: it is not a finite number
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        name = f"{reward.__module__}:{getattr(reward, '__qualname__', type(reward).__name__)}"
        raise ValueError(f"reward must be a function that returns finite numbers, got {value!r} from {name}")
    return number
