"""The parameters of an environment: each is a field with its check, default, effect and control."""
# ruff: noqa: RUF009 (parameter() returns a dataclasses.field())

import difflib
import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from typing import Any, Literal, NamedTuple

from bulletarm_gym import config_checks as checks
from bulletarm_gym.config_checks import Check, ParameterError, check_argument
from bulletarm_gym.randomization import json_ranges
from bulletarm_gym.registry import ROBOTS, SENSORS, SURFACES

__all__ = ["Context", "EnvConfig", "ParameterError", "TaskDefaults", "UnknownParameterError"]

CLOSE_LOOP = "close_loop"
OPEN_LOOP = "open_loop"

ORTHOGRAPHIC = "orthographic"
"""View that looks straight down on meshes."""

MAX_TRANSLATION = 0.05
"""Maximum translation (m) of a closed-loop action along an axis (paper, Close-Loop 4D Benchmark)."""
MAX_ROTATION = math.pi / 4.0
"""Maximum rotation (rad) of a closed-loop action about z (paper, Close-Loop 4D Benchmark)."""
HOME_HEIGHTS = {CLOSE_LOOP: 0.2, OPEN_LOOP: 0.4}
"""Default heights (m) of the fingertips at reset, see :func:`default_home_height`."""
LIFT_HEIGHT = 0.15
"""Height (m) of the fingertips above z = 0 that counts as lifted (paper, Block Picking, Object Grasping)."""
SCALE_STEP = 0.02
"""Distance between neighbouring scales of objects."""
WORKSPACES = {
    CLOSE_LOOP: [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]],
    OPEN_LOOP: [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]],
}
"""Default workspace (m) of each control (paper, Benchmark Details)."""
WIDE = [[0.25, 0.65], [-0.2, 0.2], [0.0, 0.3]]
"""Closed-loop workspace (m) of tasks that need the space of an open-loop workspace."""
SEQUENCES = {CLOSE_LOOP: ("pxyz", "pxyzr"), OPEN_LOOP: ("xy", "xyr", "xyzrrr", "pxy", "pxyr", "pxyzrrr")}
"""Values of ``action_sequence``, their characters in any order (paper, Environment)."""
PROGRESS = "progress"
"""Value of ``reward`` for potential-based shaping."""
PRESETS: dict[str, dict[str, tuple[str, ...]]] = {
    CLOSE_LOOP: {"image": ("heightmap", "holding"), "state": ("state", "holding")},
    OPEN_LOOP: {"image": ("heightmap", "in_hand", "holding")},
}
"""Names of lists of sensors for ``observation``, by control."""

Effect = Literal["scene", "motion", "observation", "episode", "rendering"]
"""Effect of a parameter: bodies and their limits, which states share; motions of the robot; observations
only; starts, rewards and ends of episodes; or rendered images only."""


class UnknownParameterError(ParameterError, TypeError):
    """A parameter does not exist.

    Python's own error for it is a ``TypeError``. Libraries that try parameters out, such as TorchRL's
    ``GymEnv``, catch that type and look for its text.
    """


@dataclass(frozen=True)
class TaskDefaults:
    """Defaults and accepted values of the parameters of a task.

    :param num_objects: the paper's number
    :param max_steps: the paper's limit
    :param object_scale: scale that gives the paper's sizes
    :param allowed_objects: accepted values of ``num_objects``
    :param needs_tray: why the task cannot be placed outside a tray, or empty if it can
    :param no_tray: why the task cannot be placed in a tray, or empty if it can
    :param level_ground: why the task cannot be placed on ramps and bumps, or empty if it can
    :param takes_object_set: whether a user's objects can replace the task's objects
    :param lifts: whether the goal is to lift an object to ``lift_height``
    :param sensors: sensors in addition to the preset ``"image"``
    :param close_loop: defaults that differ in closed-loop control, for a task of both controls
    """

    num_objects: int
    max_steps: int = 50
    object_scale: float = 1.0
    allowed_objects: tuple[int, ...] = (1,)
    needs_tray: str = ""
    no_tray: str = ""
    level_ground: str = ""
    takes_object_set: bool = False
    lifts: bool = False
    sensors: tuple[str, ...] = ()
    close_loop: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        allowed = checks.instances(int, "integers", can_be_empty=False)
        sensors = checks.instances(str, "names of sensors")
        fields = {"allowed_objects": allowed, "sensors": sensors, "close_loop": checks.mapping}
        checks.check_fields(self, fields)


@dataclass(frozen=True)
class Context:
    """The components on which checks and defaults of parameters depend.

    :param control: kind of the control, ``"close_loop"`` or ``"open_loop"``
    :param surface: name or import path of the surface
    :param sequences: values of ``action_sequence``, the default first; empty for the built-in controls
    """

    control: str
    task: TaskDefaults
    surface: str = "flat"
    sequences: tuple[str, ...] = ()

    @property
    def is_sloping(self) -> bool:
        """Whether objects can be tilted on the surface."""
        return bool(SURFACES.find(self.surface).sloping)


class Depends(NamedTuple):
    """A check or a default that depends on the context."""

    on: Callable[[Context], Any]


def parameter(check: Any, default: Any, effect: Effect, control: str = "") -> Any:
    """Return the dataclass field of a parameter.

    :param check: check of its values, or :class:`Depends`
    :param default: default value, or :class:`Depends`
    :param effect: effect of the parameter
    :param control: the control that has the parameter, by default both
    """
    return field(metadata={"check": check, "default": default, "effect": effect, "control": control})


def _sequence(context: Context) -> str:
    if context.control == CLOSE_LOOP:
        return "pxyzr"
    return "pxyzrrr" if context.is_sloping else "pxyr"


def _tray_check(task: TaskDefaults) -> Check:
    if not (reason := task.needs_tray or task.no_tray):
        return checks.boolean
    return checks.choice(bool(task.needs_tray), must=f"{bool(task.needs_tray)} with this task: {reason}")


def _observation(context: Context) -> Any:
    sensors = context.task.sensors
    return [*PRESETS[context.control]["image"], *sensors] if sensors else "image"


NO_OBJECT_SET = checks.choice(None, must="None with this task: its objects cannot be replaced")
NO_LIFT = checks.choice(LIFT_HEIGHT, must=f"{LIFT_HEIGHT} with this task: its goal is not to lift objects")


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Parameters of an environment (paper, List of Configurable Environment Parameters; and more).

    Values are plain JSON: arrays are stored as lists. Use :meth:`of` to construct one.

    :param control: kind of the control, ``"close_loop"`` or ``"open_loop"``; follows from the id
    :param robot: name or import path of the robot
    :param action_sequence: one character for each number of the action, in its order
    :param workspace: [[x low, x high], [y low, y high], [z low, z high]] (m); square in x and y
    :param object_scale_range: [low, high] scales relative to the nominal sizes; sampled from a grid of 0.02
        for each object on its own, in Box Palletizing for all boxes. If a task's default is 0.8, 1.0 gives
        larger objects
    :param max_steps: maximum number of actions in an episode
    :param num_objects: number of objects in the scene
    :param obs_size: side length (pixels) of the heightmap
    :param fast_mode: move the arm without simulation where it can touch nothing
    :param random_orientation: sample the initial yaw of objects
    :param half_rotation: limit the yaw of open-loop actions to [0, pi); else it is in [-pi, pi)
    :param in_hand_size: side length (pixels) of the open-loop in-hand image
    :param workspace_check: ``"point"`` if the centres of mass of objects must stay in the workspace,
        ``"bounding_box"`` if whole objects must
    :param close_loop_tray: place the task in a tray
    :param object_set: None for the 86 built-in objects, a folder of OBJ, STL or URDF files, or a list of
        kinds
    :param view: ``"orthographic"``, straight down, or ``"point_cloud"``, from the paper's two side cameras
    :param observation: ``"image"``, ``"state"`` (the poses of gripper and objects), or a list of sensors,
        each a name or ``{"name": ..., parameter: value, ...}``
    :param randomization: None, ``"light"``, ``"real"``, or a dict of ranges, see
        :class:`~bulletarm_gym.randomization.Randomization`; sampled at every reset
    :param physics_mode: ``"fast"`` (50 solver iterations) or ``"slow"`` (200, and slower motions)
    :param reward: None for the task's reward, ``"progress"`` for it with potential-based shaping (Ng et al.
        1999), or ``"module:function"``, called as ``function(scene, outcome)``
    :param render_mode: None, ``"rgb_array"``, ``"depth_array"`` or ``"human"``
    :param render_size: [width, height] (pixels) of rendered images, or a number for both
    :param render_camera: None, or a dict with some of ``position`` and ``target`` (m) and ``fov`` (degrees)
    :param home_height: height (m) of the fingertips above z = 0 at reset and, in open-loop control, between
        actions
    :param lift_height: height (m) above z = 0 to which the fingertips must lift an object
    """

    control: str
    robot: str = parameter(Depends(lambda _: checks.robot(ROBOTS.names)), "kuka", "scene")
    action_sequence: str = parameter(
        Depends(lambda c: checks.action_sequence(c.sequences or SEQUENCES[c.control])),
        Depends(lambda c: c.sequences[0] if c.sequences else _sequence(c)),
        "motion",
    )
    workspace: list[list[float]] = parameter(
        checks.workspace, Depends(lambda c: WORKSPACES[c.control]), "scene"
    )
    object_scale_range: list[float] = parameter(
        checks.scale_range, Depends(lambda c: [c.task.object_scale] * 2), "scene"
    )
    max_steps: int = parameter(checks.integer(1), Depends(lambda c: c.task.max_steps), "episode")
    num_objects: int = parameter(
        Depends(lambda c: checks.choice(*c.task.allowed_objects)),
        Depends(lambda c: c.task.num_objects),
        "scene",
    )
    home_height: float = parameter(checks.positive, None, "motion")
    obs_size: int = parameter(checks.integer(16, 1024), 128, "observation")
    fast_mode: bool = parameter(checks.boolean, True, "motion")
    random_orientation: bool = parameter(checks.boolean, True, "episode")
    half_rotation: bool = parameter(checks.boolean, True, "motion", OPEN_LOOP)
    in_hand_size: int = parameter(
        checks.integer(8, 256), Depends(lambda c: 40 if c.surface == "bump" else 24), "observation", OPEN_LOOP
    )
    workspace_check: str = parameter(checks.choice("point", "bounding_box"), "point", "episode")
    close_loop_tray: bool = parameter(
        Depends(lambda c: _tray_check(c.task)),
        Depends(lambda c: bool(c.task.needs_tray)),
        "scene",
        CLOSE_LOOP,
    )
    object_set: str | list[str] | None = parameter(
        Depends(lambda c: checks.optional(checks.object_set) if c.task.takes_object_set else NO_OBJECT_SET),
        None,
        "scene",
    )
    view: str = parameter(checks.choice(ORTHOGRAPHIC, "point_cloud"), ORTHOGRAPHIC, "observation", CLOSE_LOOP)
    observation: str | list[Any] = parameter(
        Depends(lambda c: checks.observation(tuple(PRESETS[c.control]), tuple(SENSORS.builtin))),
        Depends(_observation),
        "observation",
    )
    randomization: str | dict[str, list[float]] | None = parameter(
        Depends(lambda c: partial(json_ranges, is_open_loop=c.control == OPEN_LOOP)), None, "episode"
    )
    physics_mode: str = parameter(checks.choice("fast", "slow"), "fast", "motion")
    reward: str | None = parameter(checks.optional(checks.function_path(PROGRESS)), None, "episode")
    render_mode: str | None = parameter(
        checks.choice(None, "rgb_array", "depth_array", "human"), None, "rendering"
    )
    render_size: list[int] = parameter(checks.render_size, [480, 480], "rendering")
    render_camera: dict[str, Any] | None = parameter(checks.optional(checks.camera), None, "rendering")
    lift_height: float = parameter(
        Depends(lambda c: checks.positive if c.task.lifts else NO_LIFT), LIFT_HEIGHT, "episode", CLOSE_LOOP
    )

    @classmethod
    def of(
        cls, context: Context, parameters: Mapping[str, Any], defaults: Mapping[str, Any] | None = None
    ) -> "EnvConfig":
        """Check parameters, and use defaults for the others.

        :param defaults: defaults of the environment's id, which replace the task's defaults
        :raises UnknownParameterError: a parameter does not exist; the text names a similar one or all
        :raises ParameterError: a value is invalid, or the task cannot be placed on the surface
        """
        close_loop = context.task.close_loop if context.control == CLOSE_LOOP else {}
        given = {**close_loop, **(defaults or {}), **parameters}
        for name, value in given.items():
            if name not in PARAMETERS or not belongs(name, context.control):
                raise UnknownParameterError(_unknown(name, value, context.control))
        chosen = {name: deepcopy(_resolve(entry["default"], context)) for name, entry in PARAMETERS.items()}
        for name, value in {**chosen, **given}.items():
            is_checked = name in given or (value is not None and belongs(name, context.control))
            check = _resolve(PARAMETERS[name]["check"], context)
            chosen[name] = check_argument(name, value, check) if is_checked else value
        if chosen["home_height"] is None:
            chosen["home_height"] = default_home_height(context.control, chosen["workspace"])
        _check_surface(context, chosen["close_loop_tray"])
        return cls(control=context.control, **chosen)

    def parameters(self) -> dict[str, Any]:
        """Return the control's parameters by name, as JSON values."""
        return {name: value for name, value in asdict(self).items() if belongs(name, self.control)}

    def changed(self, default: "EnvConfig", effect: Effect) -> list[str]:
        """Return the names of the parameters with an effect whose values differ from the default ones."""
        return [name for name in with_effect(effect) if getattr(self, name) != getattr(default, name)]

    @property
    def sensors(self) -> list[tuple[str, str, dict[str, Any]]]:
        """Observed sensors: the name, the sensor (its name or import path), and its parameters."""
        chosen: Any = self.observation
        entries = PRESETS[self.control][chosen] if isinstance(chosen, str) else chosen
        described = [{"name": entry} if isinstance(entry, str) else dict(entry) for entry in entries]
        named = [(entry.pop("name"), entry) for entry in described]
        return [(name, entry.pop("sensor", name), entry) for name, entry in named]

    @property
    def scales(self) -> list[float]:
        """Scales of which objects have one: a grid of 0.02 over the range, with both ends."""
        low, high = self.object_scale_range
        count = math.floor((high - low) / SCALE_STEP + 1e-6)
        grid = [round(low + SCALE_STEP * step, 6) for step in range(count + 1)]
        return grid if math.isclose(grid[-1], high) else [*grid, high]

    @property
    def centre(self) -> tuple[float, float]:
        """Centre (m) of the workspace in x and y."""
        (x0, x1), (y0, y1), _ = self.workspace
        return ((x0 + x1) / 2.0, (y0 + y1) / 2.0)

    @property
    def workspace_size(self) -> float:
        """Side length (m) of the workspace."""
        return self.workspace[0][1] - self.workspace[0][0]


PARAMETERS: dict[str, Mapping[str, Any]] = {
    entry.name: entry.metadata for entry in fields(EnvConfig) if entry.metadata
}
"""Check, default, effect and control of each parameter, by name."""


def belongs(name: str, control: str) -> bool:
    """Return whether a control has a parameter."""
    return name in PARAMETERS and PARAMETERS[name]["control"] in ("", control)


def with_effect(effect: Effect) -> list[str]:
    """Return the names of the parameters with an effect."""
    return [name for name, entry in PARAMETERS.items() if entry["effect"] == effect]


def _resolve(entry: Any, context: Context) -> Any:
    return entry.on(context) if isinstance(entry, Depends) else entry


def default_home_height(control: str, workspace: list[list[float]]) -> float:
    """Return the default of ``home_height`` (m): above the floor in open loop, else within the workspace."""
    low, high = workspace[2]
    height = HOME_HEIGHTS[control]
    return low + height if control == OPEN_LOOP else min(max(height, low), high)


def _check_surface(context: Context, in_tray: bool) -> None:
    """Check that the task can be placed on the surface."""
    level = context.task.level_ground or ("its tray is placed on a level surface" if in_tray else "")
    reasons = {name: level if kind.sloping else "" for name, kind in SURFACES.builtin.items()}
    reasons["tray"] = context.task.no_tray
    if reason := level if context.is_sloping else reasons.get(context.surface, ""):
        others = " or ".join(repr(name) for name, refused in reasons.items() if not refused)
        raise ParameterError.of("surface", context.surface, f"{others} with this task", reason)


def _unknown(name: str, value: object, control: str) -> str:
    """Return the text of the error for an unknown parameter."""
    known = [*filter(lambda known: belongs(known, control), PARAMETERS), "surface"]
    near = difflib.get_close_matches(name, known, n=1)
    advice = f"Did you mean {near[0]!r}?" if near else f"Choose from {', '.join(known)}."
    if name in PARAMETERS:
        kind = "closed" if PARAMETERS[name]["control"] == CLOSE_LOOP else "open"
        advice = f"It belongs to {kind}-loop environments."
    return f"{name} must not be passed, got an unexpected keyword argument {name!r} ({value!r}). {advice}"
