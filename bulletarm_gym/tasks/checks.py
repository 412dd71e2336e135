"""Checks of combinations of parameters, task and robot, and of the values that a task's methods return."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError, default_home_height
from bulletarm_gym.geometry import Footprint, Pose
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.robots import RobotModel
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.simulation import BodySpec
from bulletarm_gym.tasks.task import Task

INFO = frozenset({"is_success", "is_valid", "ignored"})
"""Keys of ``info`` that the environment sets."""
OPTIONS = {"new_scene": ((bool, True), (bool, False)), "start": ((str, "goal"),)}
"""Types and values of the options of a reset; types, because 1 equals True."""
CLEARANCE = 0.001
"""Clearance (m) that the open fingers need around an object."""


def check_scene(config: EnvConfig, default: EnvConfig, scene: Scene, task: Task) -> None:
    """Check that workspace, home height and objects fit the robot.

    :param default: default parameters of the environment
    :raises ParameterError: they do not
    """
    _check_base(config, scene.robot.model)
    _check_home(config, scene)
    if config.object_set is not None:
        _check_widths(config, scene, "object_set", scene.objects)
    if config.object_scale_range != default.object_scale_range:
        _check_widths(config, scene, "object_scale_range", task.grasped(scene))


def _check_base(config: EnvConfig, model: RobotModel) -> None:
    """Check that the workspace is next to the base of the robot, and not behind it."""
    if model.jumps_inside(config.workspace):
        x, y, yaw = model.base.x, model.base.y, model.base.yaw
        must = f"without the base of robot={config.robot!r} and the line behind it"
        reason = (
            f"the base is at ({x:g}, {y:g}) with a yaw of {yaw:.4g} rad, where the first joint would jump"
        )
        raise ParameterError.of("workspace", config.workspace, must, reason)


def check_heights(config: EnvConfig, default: EnvConfig, task: Task) -> None:
    """Check that the gripper can descend to the objects and lift them within the workspace.

    :param default: default parameters of the environment
    :raises ParameterError: it cannot
    """
    low, high = config.workspace[2]
    if config.lift_height != default.lift_height and high <= task.height == config.lift_height:
        must = f"below {high:g} m, the top of the workspace"
        raise ParameterError.of("lift_height", config.lift_height, must)
    if high <= task.height:
        must = f"a workspace with z high above {task.height:.4g} m, to which this task lifts objects"
        raise ParameterError.of("workspace", config.workspace, must)
    smallest = CUBE_SIZE * min(config.scales)
    if config.control == CLOSE_LOOP and low >= smallest:
        if config.scales != default.scales and low < CUBE_SIZE * min(default.scales):
            must = f"above {low / CUBE_SIZE:.4g}, as the gripper descends to {low:g} m"
            raise ParameterError.of("object_scale_range", config.object_scale_range, must)
        must = f"a workspace with z low below {smallest:.4g} m, so that the gripper reaches the objects"
        raise ParameterError.of("workspace", config.workspace, must)


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


def _check_widths(config: EnvConfig, scene: Scene, parameter: str, objects: Sequence[Any]) -> None:
    """Check that the narrowest pieces of objects fit between the fingers."""
    stroke = scene.robot.model.gripper.stroke
    widths = {obj.slot.name: max(map(_narrowest, obj.slot.variants)) for obj in objects}
    wide = [f"{name} is {width:.4g} m wide" for name, width in widths.items() if width + CLEARANCE > stroke]
    if wide:
        must = f"such that objects fit between the fingers of robot={config.robot!r}, {stroke:.4g} m apart"
        raise ParameterError.of(parameter, getattr(config, parameter), must, ", ".join(wide))


def _narrowest(spec: BodySpec) -> float:
    """Return the width (m) of the narrowest piece of a body, by which it can be grasped."""
    return min(Footprint.of(piece.mesh.vertices, Pose((0.0, 0.0, 0.0))).width for piece in spec.pieces)


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
    elif not isinstance(given, Mapping) or not all(
        (type(value), value) in OPTIONS.get(name, ()) for name, value in given.items()
    ):
        must = 'None or a dict with "new_scene": True or False and "start": "goal", or with "state"'
        raise ValueError(f"options must be {must}, got {options!r}")
    elif "start" in given and not task.has_goal_structure:
        must = f"without a start, as {type(task).__name__} has no arrange_goal()"
        raise ValueError(f"options must be {must}, got {options!r}")
    return dict(given)


def checked_slots(slots: Any, task: Task) -> Sequence[ObjectSlot]:
    """Return the object slots of a task's ``bodies()``.

    :raises ValueError: they are something else, or two have the same name
    """
    if not isinstance(slots, Sequence) or not all(isinstance(slot, ObjectSlot) for slot in slots):
        raise ValueError(f"bodies() of {type(task).__name__} must return a list of slots, got {slots!r}")
    names = [slot.name for slot in slots]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"bodies() of {type(task).__name__} must return slots with distinct names, "
            f"got {', '.join(map(repr, twice))} more than once"
        )
    return slots


def checked_predicates(predicates: Any, task: Task) -> dict[str, bool]:
    """Return the predicates of a task's ``evaluate()`` as bools.

    :raises ValueError: ``"success"`` is missing, or a name is one of the environment's own
    """
    if not isinstance(predicates, Mapping) or "success" not in predicates or not INFO.isdisjoint(predicates):
        got = list(predicates) if isinstance(predicates, Mapping) else predicates
        raise ValueError(
            f"evaluate() of {type(task).__name__} must return a dict with 'success' and without "
            f"{', '.join(map(repr, sorted(INFO)))}, got {got!r}"
        )
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
