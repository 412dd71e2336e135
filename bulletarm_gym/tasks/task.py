"""Base class of tasks, and the arrangement of a scene at the start of an episode."""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, TaskDefaults, default_home_height
from bulletarm_gym.config_checks import ParameterError, check_argument, instances, truth
from bulletarm_gym.control import Control, GraspParams
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.pick_place import OVERHANG
from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.observations import Overlay
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject
from bulletarm_gym.scene.predicates import loose_objects
from bulletarm_gym.scene.state import declare_state_types
from bulletarm_gym.surfaces.surface import SITE, Point

ARRANGEMENTS = 30
"""Maximum number of arrangements that a reset tries."""


class Task(ABC):
    """A task: its bodies, their arrangement, its success, and the plan of an expert.

    A task keeps only :attr:`memory` between calls. Everything else depends on the scene, so that states can
    be saved and restored.

    :param config: the environment's parameters
    """

    defaults: ClassVar[TaskDefaults]
    controls: ClassVar[tuple[str, ...]]
    """Kinds of controls that can solve the task."""
    single_step: ClassVar[bool] = False
    """Whether every action ends the episode."""
    memory_types: ClassVar[tuple[type, ...]] = ()
    """Dataclasses and named tuples in :attr:`memory`, for files of states; plain values need none."""
    grasps: ClassVar[bool] = True
    """Whether the loose objects must fit between the open fingers."""
    pushes: ClassVar[bool] = False
    """Whether the fingers push objects at the surface, up to the border of the workspace."""
    instructions: ClassVar[tuple[str, ...]] = ()
    """Sentences that describe the goal, for policies with language inputs; by default the first of the
    docstring, or the class name in words.

    ``{num_objects}`` stands for the number of objects, and ``{surface}`` for words such as " in the tray"."""
    site: Point = SITE
    """Width and length (m) of the base of a structure, for which ramps and bumps have level ground."""

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.memory: Any = None
        """Memory of the task within an episode: plain values and :attr:`memory_types`."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Declare the types of the memory.

        :raises ValueError: ``memory_types`` has a type that cannot be stored, or whose name is in use
        """
        super().__init_subclass__(**options)
        declare_state_types(cls.memory_types)

    def instruct(self, surface: str) -> tuple[str, ...]:
        """Return :attr:`instructions` with the number of objects and words for the surface.

        :param surface: such as "in the tray"; empty for the plane
        :raises ValueError: the instructions are not a tuple of sentences, or have an unknown field
        """
        fields = {"num_objects": self.config.num_objects, "surface": surface and f" {surface}"}
        try:
            if not isinstance(self.instructions, tuple):
                raise TypeError
            sentences = tuple(str.format(sentence, **fields) for sentence in self.instructions)
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            must = "a tuple of sentences with no fields except {num_objects} and {surface}"
            name = f"instructions of {type(self).__name__}"
            raise ValueError(f"{name} must be {must}, got {self.instructions!r}") from error
        paragraph = (type(self).__doc__ or "").strip().split("\n\n")[0]
        words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", type(self).__name__).capitalize()
        return sentences or (" ".join(paragraph.split()) or f"{words}.",)

    @property
    def grasp_params(self) -> GraspParams:
        """Grasp parameters; by default the fingertips close at half the height of a largest cube."""
        return GraspParams(pick_offset=CUBE_SIZE * max(self.config.scales) / 2.0)

    @property
    def height(self) -> float:
        """Height (m) to which objects must be lifted; by default that of a largest cube."""
        return CUBE_SIZE * max(self.config.scales)

    @property
    def plans_moves(self) -> bool:
        """Whether the plan has only picks and places, to which closed-loop control adds the path."""
        return OPEN_LOOP in self.controls

    @abstractmethod
    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the slots of all objects of the task."""

    @abstractmethod
    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the objects of a new episode in an empty scene.

        :raises PlacementError: the objects do not fit; the environment tries again with other ground
        """

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place all loose objects as the finished structure at the surface's goal site in an empty scene.

        Deconstruction starts from it (paper, Expert Demonstrations).

        :raises ValueError: the task builds no structure
        """
        raise ValueError(f"{type(self).__name__} builds no structure: it has no arrange_goal()")

    @property
    def has_goal_structure(self) -> bool:
        """Whether the task defines :meth:`arrange_goal`."""
        return type(self).arrange_goal is not Task.arrange_goal

    @abstractmethod
    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return named facts about the scene; ``"success"`` is the goal.

        ``info`` has the other facts, and ``is_success``: the goal is reached in a valid scene.
        """

    @abstractmethod
    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Yield the remaining waypoints, the next one first.

        Every state has a next waypoint, also after a failure; for open-loop control one with a ``finish``.
        """

    def continue_scene(self, scene: Scene, rng: np.random.Generator) -> bool:
        """Start an episode with the objects that the last one left; return False for a new arrangement."""
        return False

    def overlays(self, scene: Scene) -> tuple[Overlay, ...]:
        """Return marks without a body that the heightmap shows, such as goals."""
        return ()

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:  # noqa: B027 (most have none)
        """Change the scene after an action."""

    def is_valid(self, scene: Scene) -> bool:
        """Return True if every loose object that is not grasped is inside the workspace."""
        held = scene.robot.held
        return all(self._is_inside(obj) for obj in loose_objects(scene) if obj.body is not held)

    def reward(self, scene: Scene, outcome: Mapping[str, bool]) -> float:
        """Return 1 on success, else 0 (paper, Environment).

        :param outcome: the step's ``info``
        """
        return float(outcome["is_success"])

    def goals(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Return the achieved and the desired goal, (n,) each, for goal-conditioned learners.

        :raises ValueError: the task has no goal of this form
        """
        raise ValueError(f"{type(self).__name__} is not goal-conditioned: it has no goals()")

    def goal_error(self, achieved: FloatArray, desired: FloatArray) -> FloatArray:
        """Return the distances between goals (..., n), relative to the distance at which a goal is reached.

        :raises ValueError: the task has no :meth:`goals`
        """
        raise ValueError(f"{type(self).__name__} is not goal-conditioned: it has no goal_error()")

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        """Return the number of finished parts of the task and of all its parts; by default 0 of 1.

        The reward ``"progress"`` depends on them.

        :param rng: samples the choices of the plan
        """
        return 0, 1

    def _is_inside(self, obj: SceneObject) -> bool:
        """Return True if the centre of mass or bounding box is in the workspace, and not below the floor."""
        (x0, x1), (y0, y1), (_, top) = self.config.workspace
        if self.config.workspace_check == "bounding_box":
            low, high = obj.bounds.tolist()
        else:
            low = high = obj.centre_of_mass
        inside = x0 <= low[0] and high[0] <= x1 and y0 <= low[1] and high[1] <= y1
        return inside and obj.pose.z >= 0.0 and high[2] <= top


def arrange_scene(
    scene: Scene,
    control: Control[Any],
    arrange: Callable[[Scene, np.random.Generator], None],
    rng: np.random.Generator,
    changed: Sequence[str],
) -> None:
    """Sample surfaces and arrangements until the objects fit.

    :param arrange: arrangement of the task in an empty scene
    :param changed: names of the parameters of the scene that differ from their defaults, for errors
    """
    for attempt in range(1, ARRANGEMENTS + 1):
        scene.clear(rng)
        control.start()
        try:
            return arrange(scene, rng)
        except PlacementError as error:
            if attempt == ARRANGEMENTS:
                values = ", ".join(repr(getattr(scene.config, name)) for name in changed)
                must = f"{', '.join(changed)} must leave room for all objects, got {values}: "
                raise PlacementError(f"{must if changed else ''}{error}") from error


NARROWED = ("object_scale_range", "num_objects", "randomization")
"""Parameters that options of a reset can narrow."""
INFO = frozenset({"is_success", "is_valid", "ignored"})
"""Keys of ``info`` that the environment sets."""
CLEARANCE = 0.001
"""Clearance (m) that the open fingers need around an object."""


def check_scene(config: EnvConfig, default: EnvConfig, scene: Scene, task: Task) -> None:
    """Raise a ParameterError if workspace, heights and objects do not fit each other and the robot.

    :param default: default parameters of the environment
    """
    _check_heights(config, default, task)
    model = scene.robot.model
    if model.jumps_inside(config.workspace):
        base = f"its base at ({model.base.x:g}, {model.base.y:g}) and the line behind it, where it would jump"
        raise ParameterError.of("workspace", config.workspace, f"outside of robot={config.robot!r}: {base}")
    _check_home(config, scene)
    if task.pushes and config.close_loop_tray and model.gripper.overhang > OVERHANG:
        reason = "its palm is wider than its fingers and stops at the tray's walls"
        raise ParameterError.of("close_loop_tray", True, f"False with robot={config.robot!r}", reason)
    scale = "object_scale_range"
    name = scale if config.object_set is None else "object_set"
    if config.object_set is not None or (task.grasps and getattr(config, scale) != getattr(default, scale)):
        _check_widths(config, scene, name)


def _check_heights(config: EnvConfig, default: EnvConfig, task: Task) -> None:
    """Check that the gripper can descend to the objects and lift them within the workspace."""
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
    low, top = config.workspace[2]
    high = top if config.control == CLOSE_LOOP else math.inf
    if not low <= config.home_height <= high:
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
    """Return the valid options of a reset; ``set_state()`` checks a state."""
    given = {} if options is None else options
    if isinstance(given, Mapping) and "state" in given:
        if len(given) > 1:
            raise ValueError(f"options must have no others next to 'state', got {sorted(given)}")
        if getattr(given["state"], "ended", False):
            raise ValueError("state must be before the end of its episode, got one after it")
        return dict(given)
    if (
        not isinstance(given, Mapping)
        or not given.keys() <= {"new_scene", "start", *NARROWED}
        or not isinstance(given.get("new_scene", False), bool)
        or given.get("start", "goal") != "goal"
    ):
        values = ('"new_scene": True or False', '"start": "goal"', *map(repr, NARROWED))
        must = f'None or a dict with {", ".join(values)}, or with "state"'
        raise ValueError(f"options must be {must}, got {options!r}")
    if "start" in given and not task.has_goal_structure:
        must = f"without a start, as {type(task).__name__} has no arrange_goal()"
        raise ValueError(f"options must be {must}, got {options!r}")
    return dict(given)


def checked_slots(slots: Any, task: Task) -> Sequence[ObjectSlot]:
    """Return the valid object slots of a task's ``bodies()``."""
    name = f"bodies() of {type(task).__name__}"
    found: tuple[ObjectSlot, ...] = check_argument(name, slots, instances(ObjectSlot, "slots"))
    must, names = f"{name} must return", [slot.name for slot in found]
    if len(set(names)) < len(names):
        raise ValueError(f"{must} slots with distinct names, got {', '.join(map(repr, names))}")
    for number, slot in enumerate(found):
        alike = [other for other in found[:number] if other.name == slot.like and not other.like]
        if slot.like and [len(other.variants) for other in alike] != [len(slot.variants)]:
            reason = f"an earlier slot with {len(slot.variants)} variants as like of {slot.name!r}"
            raise ValueError(f"{must} {reason}, got {slot.like!r}")
    return found


def evaluated(task: Task, scene: Scene, ignored: bool) -> dict[str, bool]:
    """Return the predicates of a task and the environment; ``is_success`` is success in a valid scene.

    :param ignored: whether the last action changed nothing
    """
    predicates: Any = task.evaluate(scene)
    if not isinstance(predicates, Mapping) or "success" not in predicates or not INFO.isdisjoint(predicates):
        must = f"a dict with 'success' and without {', '.join(map(repr, sorted(INFO)))}"
        raise ValueError(f"evaluate() of {type(task).__name__} must return {must}, got {predicates!r}")
    name = f"of evaluate() of {type(task).__name__}"
    values = {key: bool(check_argument(f"{key} {name}", value, truth)) for key, value in predicates.items()}
    is_valid = bool(task.is_valid(scene))
    success = values.pop("success") and is_valid
    return {"is_success": success, "is_valid": is_valid, "ignored": ignored, **values}


def finite_reward(value: Any, reward: Callable[..., Any]) -> float:
    """Return a valid reward as a number."""
    number = np.asarray(value)
    if number.shape or number.dtype.kind not in "biuf" or not np.isfinite(number):
        name = f"{reward.__module__}:{getattr(reward, '__qualname__', type(reward).__name__)}"
        must = "a function that returns finite numbers"
        raise ParameterError.of("reward", value, must, f"returned by {name}")
    return float(number)
