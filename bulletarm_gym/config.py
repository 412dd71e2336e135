"""The parameters of an environment, checked once, at the door."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from bulletarm_gym import values
from bulletarm_gym.values import Check, Refused

CLOSE_LOOP = "close_loop"
OPEN_LOOP = "open_loop"

ORTHOGRAPHIC = "orthographic"
"""The view that looks straight down on meshes."""

MAX_TRANSLATION = 0.05
"""Largest translation (m) of a close-loop action along an axis (paper, Close-Loop 4D Benchmark)."""
MAX_ROTATION = math.pi / 4.0
"""Largest rotation (rad) of a close-loop action about z (paper, Close-Loop 4D Benchmark)."""

HOME_HEIGHTS = {CLOSE_LOOP: 0.2, OPEN_LOOP: 0.4}
"""Default heights (m) of the fingertips at reset, see :func:`default_home_height`."""
LIFT_HEIGHT = 0.15
"""Height (m) of the fingertips above z = 0 that counts as lifted (paper, Block Picking, Object Grasping)."""

LEVEL, SLOPING = ("flat", "tray"), ("ramp", "bump")
"""Kinds of ground."""


class ParameterError(ValueError):
    """A parameter is unknown or has a value it cannot take.

    Made from its whole text, so that it can be pickled and made anew by those who add to the text.
    """

    @classmethod
    def of(cls, name: str, got: object, takes: str) -> "ParameterError":
        """Return the error that says what a parameter got and what it takes."""
        return cls(f"{name}: got {got!r}, takes {takes}")


class UnknownParameterError(ParameterError, TypeError):
    """There is no such parameter.

    Python's own error for it is a ``TypeError``: libraries that try out which parameters an environment has
    (TorchRL's ``GymEnv`` does) catch that, and look for its words.
    """

    @classmethod
    def of(cls, name: str, got: object, takes: str) -> "UnknownParameterError":
        """Return the error for a parameter by its name, with its value and what would be right."""
        return cls(f"{name}: got an unexpected keyword argument {name!r} ({got!r}), takes {takes}")


@dataclass(frozen=True)
class TrayUse:
    """Whether a task can stand in a tray.

    :param choices: what ``close_loop_tray`` may be, the default first
    :param reason: why it cannot be anything else
    """

    choices: tuple[bool, ...] = (False, True)
    reason: str = ""


WORKSPACES = {
    "close_loop": [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]],
    "open_loop": [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]],
}
"""The default workspace (m) of each control (paper, Benchmark Details)."""
WIDE = [[0.25, 0.65], [-0.2, 0.2], [0.0, 0.3]]
"""Close-loop workspace (m) of tasks that need the room of an open-loop one."""


@dataclass(frozen=True)
class TaskDefaults:
    """What a task prescribes for its own parameters.

    :param num_objects: the paper's number
    :param max_steps: the paper's limit
    :param object_scale: gives exactly the paper's sizes
    :param allowed_objects: every number the task can have
    :param tray: whether it can stand in a tray
    :param level_ground: why it cannot stand on ramps and bumps, if so
    :param takes_object_set: whether its objects can be replaced by a user's
    :param lifts: whether its goal is to lift an object to ``lift_height``
    :param sensors: what must be seen besides the default images
    :param close_loop: parameters with other defaults in close loop, of a task for both controls
    """

    num_objects: int
    max_steps: int = 50
    object_scale: float = 1.0
    allowed_objects: tuple[int, ...] = (1,)
    tray: TrayUse = TrayUse()
    level_ground: str = ""
    takes_object_set: bool = False
    lifts: bool = False
    sensors: tuple[str, ...] = ()
    close_loop: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """All parameters of an environment (paper, List of Configurable Environment Parameters; and ours).

    Values are plain JSON: arrays given by a user are kept as lists. Build one with :meth:`of`.

    :param control: ``"close_loop"`` or ``"open_loop"``, of a user's control its kind; follows from the id
    :param robot: the arm, by its name or import path
    :param action_sequence: one character a number of the action, in its order
    :param workspace: [[x low, x high], [y low, y high], [z low, z high]] (m); square in x and y
    :param object_scale_range: [low, high] factors on nominal sizes, not on a task's own: where its objects
        have 0.8 times the nominal size, 1.0 asks for larger ones; a grid of 0.02 is drawn from
    :param max_steps: actions an episode
    :param num_objects: objects in the scene
    :param obs_size: pixels a side of the heightmap
    :param fast_mode: move the arm without simulation where it can touch nothing
    :param random_orientation: objects start with random yaw
    :param half_rotation: the open-loop gripper turns from 0 to pi, else all the way round
    :param in_hand_size: pixels a side of the open-loop in-hand image
    :param workspace_check: ``"point"`` asks an object's centre to stay inside, ``"bounding_box"`` all of it
    :param close_loop_tray: the task stands in a tray
    :param object_set: None for the 86 objects made by code, a folder of OBJ, STL or URDF files, or a list of
        kinds
    :param view: ``"orthographic"``, looking straight down, or ``"point_cloud"``, the paper's two side cameras
    :param observation: ``"image"``, ``"state"`` (the poses of gripper and objects), or a list of
        :data:`SENSORS`: each by its name, or ``{"name": ..., parameter: value, ...}``
    :param physics_mode: ``"fast"`` (50 solver iterations) or ``"slow"`` (200, and slower motions)
    :param reward: None for the task's own, or ``"module:function"`` called as ``function(scene, outcome)``
    :param render_mode: None, ``"rgb_array"``, ``"depth_array"`` or ``"human"``
    :param render_size: [width, height] (pixels) of rendered images, or a number for both
    :param render_camera: None, or a dict with some of ``position`` and ``target`` (m) and ``fov`` (degrees)
    :param home_height: height (m) of the fingertips above z = 0 at reset and, in open loop, between actions
    :param lift_height: height (m) above z = 0 to which the fingertips must lift an object
    """

    control: str
    robot: str
    action_sequence: str
    workspace: list[list[float]]
    object_scale_range: list[float]
    max_steps: int
    num_objects: int
    home_height: float
    obs_size: int = 128
    fast_mode: bool = True
    random_orientation: bool = True
    half_rotation: bool = True
    in_hand_size: int = 24
    workspace_check: str = "point"
    close_loop_tray: bool = False
    object_set: str | list[str] | None = None
    view: str = ORTHOGRAPHIC
    observation: str | list[Any] = "image"
    physics_mode: str = "fast"
    reward: str | None = None
    render_mode: str | None = None
    render_size: list[int] = field(default_factory=lambda: [480, 480])
    render_camera: dict[str, Any] | None = None
    lift_height: float = LIFT_HEIGHT

    @classmethod
    def of(
        cls,
        control: str,
        task: TaskDefaults,
        robots: Sequence[str],
        parameters: Mapping[str, Any],
        surface: str = "flat",
        sloping: bool | None = None,
        sequences: Sequence[str] = (),
        defaults: Mapping[str, Any] | None = None,
    ) -> "EnvConfig":
        """Check a user's parameters and fill in the paper's defaults.

        :param control: which of the paper's two tables applies
        :param task: the task's own numbers
        :param robots: names of the arms there are
        :param surface: where; some defaults follow from it
        :param sloping: whether things may lie there at an angle; None for a surface of ours
        :param sequences: what an action can consist of, the default first; none for a control of ours
        :param defaults: of an environment's id, in place of the task's
        :raises UnknownParameterError: there is no such parameter; one of a similar name is offered, else
            all are listed
        :raises ParameterError: a wrong type or value, or ground that the task cannot stand on
        """
        sloping = surface in SLOPING if sloping is None else sloping
        checks = _checks(control, task, robots)
        chosen = _defaults(control, surface, sloping, task)
        if sequences:
            checks["action_sequence"] = values.sequence(sequences)
            chosen["action_sequence"] = sequences[0]
        given = {**(defaults or {}), **parameters}
        for name, value in given.items():
            if name not in checks:
                raise _unknown(name, value, control, checks)
        chosen |= {name: _checked(name, checks[name], value) for name, value in given.items()}
        chosen.setdefault("home_height", default_home_height(control, chosen["workspace"]))
        _check_surface(surface, sloping, task, chosen["close_loop_tray"])
        return cls(control=control, **chosen)

    def parameters(self) -> dict[str, Any]:
        """Return the control's parameters by name, as JSON values."""
        return {name: value for name, value in asdict(self).items() if belongs(name, self.control)}

    @property
    def sensors(self) -> list[tuple[str, str, dict[str, Any]]]:
        """What is observed: names, the sensor behind each (its name or import path), its parameters."""
        chosen: Any = self.observation
        entries = PRESETS[self.control][chosen] if isinstance(chosen, str) else chosen
        described = [{"name": entry} if isinstance(entry, str) else dict(entry) for entry in entries]
        named = [(entry.pop("name"), entry) for entry in described]
        return [(name, entry.pop("sensor", name), entry) for name, entry in named]

    @property
    def scales(self) -> list[float]:
        """The sizes that objects are drawn from: a grid of 0.02 over the range, both ends included."""
        low, high = self.object_scale_range
        count = math.floor((high - low) / SCALE_STEP + 1e-6)
        grid = [round(low + SCALE_STEP * step, 6) for step in range(count + 1)]
        return grid if math.isclose(grid[-1], high) else [*grid, high]

    @property
    def centre(self) -> tuple[float, float]:
        """Middle (m) of the workspace in x and y."""
        (x0, x1), (y0, y1), _ = self.workspace
        return ((x0 + x1) / 2.0, (y0 + y1) / 2.0)

    @property
    def workspace_size(self) -> float:
        """Side (m) of the workspace."""
        return self.workspace[0][1] - self.workspace[0][0]


SCALE_STEP = 0.02

ROBOTS = ("kuka", "panda", "ur5", "ur5_robotiq")
"""Our arms by name; users register more."""
SENSORS = (
    *("heightmap", "in_hand", "holding", "state", "color", "segmentation", "rgb", "depth", "point_cloud"),
    "joint_state",
)
"""What can be observed, by name; users register more."""
PRESETS: dict[str, dict[str, tuple[str, ...]]] = {
    CLOSE_LOOP: {"image": ("heightmap", "holding"), "state": ("state", "holding")},
    OPEN_LOOP: {"image": ("heightmap", "in_hand", "holding")},
}
"""What ``observation`` may be besides a list: names for lists of sensors, by control."""

_ONLY_WITH = {
    "half_rotation": OPEN_LOOP,
    "in_hand_size": OPEN_LOOP,
    "close_loop_tray": CLOSE_LOOP,
    "view": CLOSE_LOOP,
    "lift_height": CLOSE_LOOP,
}
"""Parameters that one control has and the other has not."""


def belongs(name: str, control: str) -> bool:
    """Whether a control has a parameter."""
    return name != "control" and _ONLY_WITH.get(name, control) == control


def _defaults(control: str, surface: str, sloping: bool, task: TaskDefaults) -> dict[str, Any]:
    """Return the paper's values where a parameter has no default of its own."""
    shared = {
        "robot": "kuka",
        "object_scale_range": [task.object_scale, task.object_scale],
        "max_steps": task.max_steps,
        "num_objects": task.num_objects,
        "close_loop_tray": task.tray.choices[0],
        "observation": [*PRESETS[control]["image"], *task.sensors] if task.sensors else "image",
    }
    if control == CLOSE_LOOP:
        return {
            **shared,
            "action_sequence": "pxyzr",
            "workspace": [list(limits) for limits in WORKSPACES[control]],
            **task.close_loop,
        }
    return shared | {
        "action_sequence": "pxyzrrr" if sloping else "pxyr",
        "workspace": [list(limits) for limits in WORKSPACES[control]],
        "in_hand_size": 40 if surface == "bump" else 24,
    }


def default_home_height(control: str, workspace: list[list[float]]) -> float:
    """Return the default of ``home_height`` (m): in open loop above the floor, else within the workspace."""
    low, high = workspace[2]
    height = HOME_HEIGHTS[control]
    return low + height if control == OPEN_LOOP else min(max(height, low), high)


def _checks(control: str, task: TaskDefaults, robots: Sequence[str]) -> dict[str, Check]:
    """Return what each parameter of a control must pass."""
    checks: dict[str, Check] = {
        "robot": values.robot(robots),
        "action_sequence": values.sequence(SEQUENCES[control]),
        "workspace": values.workspace,
        "object_scale_range": values.scale_range,
        "max_steps": values.integer(1),
        "num_objects": values.choice(*task.allowed_objects),
        "home_height": values.positive,
        "lift_height": values.positive if task.lifts else values.no_lift_height(LIFT_HEIGHT),
        "obs_size": values.integer(16, 1024),
        "fast_mode": values.boolean,
        "random_orientation": values.boolean,
        "half_rotation": values.boolean,
        "in_hand_size": values.integer(8, 256),
        "workspace_check": values.choice("point", "bounding_box"),
        "close_loop_tray": values.tray(task.tray.choices, task.tray.reason),
        "object_set": values.optional(values.object_set) if task.takes_object_set else values.no_object_set,
        "view": values.choice(ORTHOGRAPHIC, "point_cloud"),
        "observation": values.observation(list(PRESETS[control]), SENSORS, _presets_elsewhere(control)),
        "physics_mode": values.choice("fast", "slow"),
        "reward": values.optional(values.import_path),
        "render_mode": values.choice(None, "rgb_array", "depth_array", "human"),
        "render_size": values.render_size,
        "render_camera": values.optional(values.camera),
    }
    return {name: check for name, check in checks.items() if belongs(name, control)}


def accepted(control: str, task: TaskDefaults, robots: Sequence[str]) -> dict[str, str]:
    """Return what each parameter takes, by name, in the words of its errors.

    :param control: which parameters there are
    :param task: the task's own numbers
    :param robots: names of the arms there are
    """
    return {name: _takes(check) for name, check in _checks(control, task, robots).items()}


def _takes(check: Check) -> str:
    """Return what is told to those who give nothing that a parameter could be."""
    try:
        check(object())
    except Refused as refused:
        return str(refused)
    raise AssertionError(f"{check} refuses nothing")


def _presets_elsewhere(control: str) -> dict[str, str]:
    """Return why presets of the other control cannot be had."""
    own = " or ".join(map(repr, PRESETS[control]))
    return {
        preset: f"{own} or a list of sensors: {preset!r} belongs to {other.replace('_', '-')} environments"
        for other, presets in PRESETS.items()
        for preset in presets
        if preset not in PRESETS[control]
    }


def _check_surface(surface: str, sloping: bool, task: TaskDefaults, in_tray: bool) -> None:
    """Refuse ground that a task cannot stand on.

    :raises ParameterError: with the reason
    """
    refused = {} if True in task.tray.choices else {"tray": task.tray.reason}
    if task.level_ground or in_tray:
        refusing = (*SLOPING, surface) if sloping else SLOPING
        refused |= dict.fromkeys(refusing, task.level_ground or "its tray stands on level ground")
    if surface in refused:
        others = " or ".join(repr(other) for other in (*LEVEL, *SLOPING) if other not in refused)
        raise ParameterError.of("surface", surface, f"{others} with this task: {refused[surface]}")


def _unknown(name: str, value: object, control: str, checks: Mapping[str, Check]) -> UnknownParameterError:
    if name == "render":
        takes = 'nothing: there is no such parameter; use render_mode="human"'
    elif name in _ONLY_WITH:
        other, own = (text.replace("_", "-") for text in (_ONLY_WITH[name], control))
        takes = f"nothing here: it belongs to {other} environments, this one is {own}"
    else:
        known = [*checks, "surface"]
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(known)}"
        takes = f"nothing: there is no such parameter, {hint}"
    return UnknownParameterError.of(name, value, takes)


def _checked(name: str, check: Check, value: Any) -> Any:
    try:
        return check(value)
    except Refused as refused:
        raise ParameterError.of(name, value, str(refused)) from None


SEQUENCES = {CLOSE_LOOP: ("pxyz", "pxyzr"), OPEN_LOOP: ("xy", "xyr", "xyzrrr", "pxy", "pxyr", "pxyzrrr")}
"""What an action can consist of, a character a number, in any order (paper, Environment)."""


PARAMETERS = tuple(entry.name for entry in fields(EnvConfig) if entry.name != "control")
"""Names of all parameters."""
