"""What parameters, the options of a reset, or a reward ask for and cannot have."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError, default_home_height
from bulletarm_gym.control import Control
from bulletarm_gym.extensions import load
from bulletarm_gym.geometry import Footprint, PlacementError, Pose
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.robots import RobotModel
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.simulation import BodySpec
from bulletarm_gym.tasks import Task

Reward = Callable[[Scene, Mapping[str, bool]], float]

ROOM_PARAMETERS = ("object_scale_range", "num_objects", "workspace", "object_set", "close_loop_tray")
"""On what it depends whether there is room; the first that is not the task's own is named."""
OPTIONS = {"new_scene": ((bool, True), (bool, False)), "start": ((str, "goal"),)}
"""What a reset can be asked for: types, for 1 equals True, and values."""
INFO = frozenset({"is_success", "is_valid", "ignored"})
"""Keys of ``info`` that the environment itself sets."""
GRASP_PLAY = 0.001
"""Play (m) that open fingers need about what they grasp."""


def check_base(config: EnvConfig, model: RobotModel) -> None:
    """Check that the workspace is next to the base of the arm, and not behind it.

    :raises ParameterError: it is not
    """
    if model.jumps_inside(config.workspace):
        x, y, yaw = model.base.x, model.base.y, model.base.yaw
        takes = (
            f"one without the base of robot={config.robot!r} and the line behind it: the base is at "
            f"({x:g}, {y:g}) with a yaw of {yaw:.4g} rad, and there the first joint would have to jump"
        )
        raise ParameterError.of("workspace", config.workspace, takes)


def check_heights(config: EnvConfig, own: EnvConfig, task: Task) -> None:
    """Check that the workspace lets the gripper come down to things, and up with them.

    :param own: the environment's own parameters
    :raises ParameterError: it does not
    """
    low, high = config.workspace[2]
    if config.lift_height != own.lift_height and high <= task.height == config.lift_height:
        takes = f"a height below {high:g}, the top of the workspace"
        raise ParameterError.of("lift_height", config.lift_height, takes)
    if high <= task.height:
        takes = f"one with z high above {task.height:.4g} with this task: up to there things must be lifted"
        raise ParameterError.of("workspace", config.workspace, takes)
    smallest = CUBE_SIZE * min(config.scales)
    if config.control == CLOSE_LOOP and low >= smallest:
        if config.scales != own.scales and low < CUBE_SIZE * min(own.scales):
            takes = f"sizes above {low / CUBE_SIZE:.4g}: the gripper comes down to {low:g} m"
            raise ParameterError.of("object_scale_range", config.object_scale_range, takes)
        takes = f"one with z low below {smallest:.4g}: the gripper must come down to what lies on the ground"
        raise ParameterError.of("workspace", config.workspace, takes)


def check_home(config: EnvConfig, scene: Scene) -> None:
    """Check that a user's ``home_height`` is within the workspace and above the objects.

    :raises ParameterError: it is not
    """
    low, high = config.workspace[2]
    if not low <= config.home_height <= (high if config.control == CLOSE_LOOP else math.inf):
        takes = f"a height within the workspace, from {low:g} to {high:g}"
        raise ParameterError.of("home_height", config.home_height, takes)
    tallest = max((body.spec.extents[2] for item in scene.objects for body in item.bodies), default=0.0)
    if default_home_height(config.control, config.workspace) != config.home_height <= tallest:
        takes = f"a height above {tallest:.4g} with this task: so high are its objects"
        raise ParameterError.of("home_height", config.home_height, takes)


def check_spans(config: EnvConfig, own: EnvConfig, scene: Scene, task: Task) -> None:
    """Check that the gripper spans what must be grasped in its largest size, where sizes are not the task's.

    An object of several pieces can be grasped by the narrowest of them.

    :param own: the environment's own parameters
    :raises ParameterError: it does not
    """
    _check_set(config, scene)
    if config.object_scale_range == own.object_scale_range:
        return
    stroke = scene.robot.model.gripper.stroke
    for item in task.grasped(scene):
        width = max(_narrowest(spec) for spec in item.slot.variants)
        if width + GRASP_PLAY > stroke:
            takes = (
                f"one that the gripper of robot={config.robot!r} spans: it opens to {stroke:.4g} m, "
                f"{item.slot.name!r} gets {width:.4g} m wide"
            )
            raise ParameterError.of("object_scale_range", config.object_scale_range, takes)


def _check_set(config: EnvConfig, scene: Scene) -> None:
    """Check that the gripper spans every object of a user's set.

    :raises ParameterError: it does not; the message names the objects that are too wide
    """
    if config.object_set is None:
        return
    stroke = scene.robot.model.gripper.stroke
    widths = {item.slot.name: max(map(_narrowest, item.slot.variants)) for item in scene.objects}
    wide = [f"{name} is {width:.4g} m wide" for name, width in widths.items() if width + GRASP_PLAY > stroke]
    if wide:
        takes = f"objects that the gripper of robot={config.robot!r} spans: it opens to {stroke:.4g} m, "
        raise ParameterError.of("object_set", config.object_set, takes + ", ".join(wide))


def _narrowest(spec: BodySpec) -> float:
    """Return the width (m) of the narrowest piece of a body that stands as it was made to stand."""
    return min(Footprint.of(piece.mesh.vertices, Pose((0.0, 0.0, 0.0))).width for piece in spec.pieces)


def check_room(config: EnvConfig, own: EnvConfig, scene: Scene, task: Task, control: Control[Any]) -> None:
    """Check that the task finds room for its objects in their largest sizes, where they are not its own.

    It is asked to arrange them some times. If it succeeds every other time, a reset, which asks far more
    often before it gives up, does not fail.

    :param own: the environment's own parameters
    :raises ParameterError: it does not
    """
    changed = [name for name in ROOM_PARAMETERS if getattr(config, name) != getattr(own, name)]
    if not changed:
        return
    failures = 0
    for number in range(task.rehearsals):
        reason = _rehearse(scene, task, control, np.random.default_rng(number))
        failures += reason is not None
        if 2 * failures > task.rehearsals:
            takes = f"one that leaves room: {_wish(config)} has none; {reason}"
            raise ParameterError.of(changed[0], getattr(config, changed[0]), takes)
        if 2 * (number + 1 - failures) >= task.rehearsals:
            break
    scene.clear(np.random.default_rng(0))


def _rehearse(scene: Scene, task: Task, control: Control[Any], rng: np.random.Generator) -> str | None:
    """Arrange a start in the largest sizes; return why there is no room, or None."""
    scene.clear(rng)
    sizes = len(scene.config.scales)
    for item in scene.objects:
        shapes, rest = divmod(len(item.slot.variants), sizes)
        if rest == 0:  # the larger, the later
            shape = item.choices[item.variant] % shapes
            item.variant = max(n for n, place in enumerate(item.choices) if place % shapes == shape)
    control.start()
    task.memory = None
    try:
        task.arrange(scene, rng)
    except (PlacementError, ValueError) as error:
        return str(error)
    return None


def _wish(config: EnvConfig) -> str:
    objects = f"num_objects={config.num_objects} with object_scale_range up to {max(config.scales):g}"
    return f"{objects} in workspace={config.workspace}"


def checked_options(options: Mapping[str, Any] | None, task: Task) -> dict[str, Any]:
    """Return the options of a reset; a state is checked by ``set_state()``.

    :raises ValueError: not a mapping, an unknown option, an option next to a state, or the task has no
        structure to start from
    """
    given = {} if options is None else options
    if isinstance(given, Mapping) and "state" in given:
        if len(given) > 1:
            raise ValueError(f"options must have no others next to 'state', got {sorted(given)}")
        if getattr(given["state"], "ended", False):
            raise ValueError("state must be before the end of its episode, got one after it")
        return dict(given)
    if not isinstance(given, Mapping) or not all(
        (type(value), value) in OPTIONS.get(name, ()) for name, value in given.items()
    ):
        must = 'None or a dict with "new_scene": True or False and "start": "goal", or with "state"'
        raise ValueError(f"options must be {must}, got {options!r}")
    if "start" in given and not task.has_goal_structure:
        must = f"without a start: {type(task).__name__} builds no structure, it has no arrange_goal()"
        raise ValueError(f"options must be {must}, got {options!r}")
    return dict(given)


def checked_roles(roles: Any, task: Task) -> Sequence[ObjectSlot]:
    """Return the roles of a task's ``bodies()``.

    :raises ValueError: they are something else, or two have one name
    """
    if not isinstance(roles, Sequence) or not all(isinstance(role, ObjectSlot) for role in roles):
        raise ValueError(f"bodies() of {type(task).__name__} must return a list of roles, got {roles!r}")
    names = [role.name for role in roles]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"bodies() of {type(task).__name__} must return roles with distinct names, "
            f"got {', '.join(map(repr, twice))} more than once"
        )
    return roles


def checked_facts(facts: Mapping[str, Any], task: Task) -> dict[str, bool]:
    """Return the facts of a task's ``evaluate()`` as bools.

    :raises ValueError: the goal is missing, or a name is one of the environment's own
    """
    if not isinstance(facts, Mapping) or "success" not in facts or not INFO.isdisjoint(facts):
        got = list(facts) if isinstance(facts, Mapping) else facts
        raise ValueError(
            f"evaluate() of {type(task).__name__} must return a dict with 'success' and without "
            f"{', '.join(map(repr, sorted(INFO)))}, got {got!r}"
        )
    return {name: bool(value) for name, value in facts.items()}


def reward_function(path: str | None) -> Reward | None:
    """Import a user's reward function, if there is one.

    :raises ParameterError: there is none, or it is no function
    """
    try:
        found: Reward | None = None if path is None else load(path)
    except ValueError as error:
        raise ParameterError.of("reward", path, f"None or 'module:function': {error}") from error
    if not (found is None or callable(found)):
        raise ParameterError.of("reward", path, f"a function; this is a {type(found).__name__}")
    return found


def finite_reward(value: Any, reward: Callable[..., Any]) -> float:
    """Return a reward as a number.

    :raises ValueError: it is none that can be learnt from
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        name = f"{reward.__module__}:{getattr(reward, '__qualname__', type(reward).__name__)}"
        raise ValueError(f"reward: {name} returned {value!r}, takes one that returns finite numbers")
    return number
