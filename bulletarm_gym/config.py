"""The parameters of an environment, checked once, at the door."""

import difflib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

Check = Callable[[Any], Any]

CLOSE_LOOP = "close_loop"
OPEN_LOOP = "open_loop"

LEVEL, SLOPING = ("flat", "tray"), ("ramp", "bump")
"""Kinds of ground."""
SMALLEST_WORKSPACE = 0.1
"""Side (m) below which no task of the paper fits."""
LARGEST_SCALE = 2.0
"""A cube twice the nominal size (10 cm) no longer fits any gripper."""


class ParameterError(ValueError):
    """A parameter is unknown or has a value it cannot take."""

    def __init__(self, name: str, got: object, takes: str) -> None:
        super().__init__(f"{name}: got {got!r}, takes {takes}")


@dataclass(frozen=True)
class TrayUse:
    """Whether a task can stand in a tray.

    :param choices: what ``close_loop_tray`` may be, the default first
    :param reason: why it cannot be anything else
    """

    choices: tuple[bool, ...] = (False, True)
    reason: str = ""


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
    """

    num_objects: int
    max_steps: int = 50
    object_scale: float = 1.0
    allowed_objects: tuple[int, ...] = (1,)
    tray: TrayUse = TrayUse()
    level_ground: str = ""
    takes_object_set: bool = False


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """All parameters of an environment (paper, List of Configurable Environment Parameters; and ours).

    Values are plain JSON: arrays given by a user are kept as lists. Build one with :meth:`of`.

    :param control: ``"close_loop"`` or ``"open_loop"``; follows from the environment's id
    :param robot: the arm
    :param action_sequence: one character a number of the action, in its order
    :param workspace: [[x low, x high], [y low, y high], [z low, z high]] (m); square in x and y
    :param object_scale_range: [low, high] factors on nominal sizes; a grid of 0.02 is drawn from
    :param max_steps: actions an episode
    :param num_objects: objects in the scene
    :param obs_size: pixels a side of the heightmap
    :param fast_mode: move the arm without simulation where it can touch nothing
    :param random_orientation: objects start with random yaw
    :param half_rotation: the open-loop gripper turns from 0 to pi, else all the way round
    :param in_hand_size: pixels a side of the open-loop in-hand image
    :param workspace_check: ``"point"`` asks an object's centre to stay inside, ``"bounding_box"`` all of it
    :param close_loop_tray: the task stands in a tray
    :param object_set: None for the 86 objects made by code, or a folder of OBJ or URDF files
    :param view: ``"orthographic"``, looking straight down, or ``"point_cloud"``, the paper's two side cameras
    :param observation: ``"image"``, or ``"state"``: the poses of gripper and objects
    :param physics_mode: ``"fast"`` (50 solver iterations) or ``"slow"`` (200, and slower motions)
    :param reward: None for the task's own, or ``"module:function"`` called as ``function(scene, outcome)``
    :param render_mode: None, ``"rgb_array"``, ``"depth_array"`` or ``"human"``
    """

    control: str
    robot: str
    action_sequence: str
    workspace: list[list[float]]
    object_scale_range: list[float]
    max_steps: int
    num_objects: int
    obs_size: int = 128
    fast_mode: bool = True
    random_orientation: bool = True
    half_rotation: bool = True
    in_hand_size: int = 24
    workspace_check: str = "point"
    close_loop_tray: bool = False
    object_set: str | None = None
    view: str = "orthographic"
    observation: str = "image"
    physics_mode: str = "fast"
    reward: str | None = None
    render_mode: str | None = None

    @classmethod
    def of(
        cls,
        control: str,
        task: TaskDefaults,
        robots: Sequence[str],
        parameters: Mapping[str, Any],
        surface: str = "flat",
    ) -> "EnvConfig":
        """Check a user's parameters and fill in the paper's defaults.

        :param control: which of the paper's two tables applies
        :param task: the task's own numbers
        :param robots: names of the arms there are
        :param surface: where; some defaults follow from it
        :raises ParameterError: an unknown parameter (the nearest is named), a wrong type or value, or ground
            that the task cannot stand on
        """
        checks = _checks(control, task, robots)
        for name, value in parameters.items():
            if name not in checks:
                raise _unknown(name, value, control, checks)
        values = _defaults(control, surface, task) | {
            name: _checked(name, checks[name], value) for name, value in parameters.items()
        }
        _check_surface(surface, task, values["close_loop_tray"])
        return cls(control=control, **values)

    def parameters(self) -> dict[str, Any]:
        """Return the control's parameters by name, as JSON values."""
        return {name: value for name, value in asdict(self).items() if belongs(name, self.control)}

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

_ONLY_WITH = {
    "half_rotation": OPEN_LOOP,
    "in_hand_size": OPEN_LOOP,
    "close_loop_tray": CLOSE_LOOP,
    "view": CLOSE_LOOP,
}
"""Parameters that one control has and the other has not."""


def belongs(name: str, control: str) -> bool:
    """Whether a control has a parameter."""
    return name != "control" and _ONLY_WITH.get(name, control) == control


def _defaults(control: str, surface: str, task: TaskDefaults) -> dict[str, Any]:
    """Return the paper's values where a parameter has no default of its own."""
    shared = {
        "robot": "kuka",
        "object_scale_range": [task.object_scale, task.object_scale],
        "max_steps": task.max_steps,
        "num_objects": task.num_objects,
        "close_loop_tray": task.tray.choices[0],
    }
    if control == CLOSE_LOOP:
        return shared | {
            "action_sequence": "pxyzr",
            "workspace": [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]],
        }
    return shared | {
        "action_sequence": "pxyzrrr" if surface in SLOPING else "pxyr",
        "workspace": [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]],
        "in_hand_size": 40 if surface == "bump" else 24,
    }


def _checks(control: str, task: TaskDefaults, robots: Sequence[str]) -> dict[str, Check]:
    """Return what each parameter of a control must pass."""
    checks: dict[str, Check] = {
        "robot": _robot(robots),
        "action_sequence": _sequence(control),
        "workspace": _workspace,
        "object_scale_range": _scale_range,
        "max_steps": _integer(1),
        "num_objects": _choice(*task.allowed_objects),
        "obs_size": _integer(16, 1024),
        "fast_mode": _boolean,
        "random_orientation": _boolean,
        "half_rotation": _boolean,
        "in_hand_size": _integer(8, 256),
        "workspace_check": _choice("point", "bounding_box"),
        "close_loop_tray": _tray(task.tray),
        "object_set": _optional(_folder) if task.takes_object_set else _no_object_set,
        "view": _choice("orthographic", "point_cloud"),
        "observation": _choice("image", "state") if control == CLOSE_LOOP else _images_only,
        "physics_mode": _choice("fast", "slow"),
        "reward": _optional(_import_path),
        "render_mode": _choice(None, "rgb_array", "depth_array", "human"),
    }
    return {name: check for name, check in checks.items() if belongs(name, control)}


def _check_surface(surface: str, task: TaskDefaults, in_tray: bool) -> None:
    """Refuse ground that a task cannot stand on.

    :raises ParameterError: with the reason
    """
    refused = {} if True in task.tray.choices else {"tray": task.tray.reason}
    if task.level_ground or in_tray:
        refused |= dict.fromkeys(SLOPING, task.level_ground or "its tray stands on level ground")
    if surface in refused:
        others = " or ".join(repr(other) for other in (*LEVEL, *SLOPING) if other not in refused)
        raise ParameterError("surface", surface, f"{others} with this task: {refused[surface]}")


def _unknown(name: str, value: object, control: str, checks: Mapping[str, Check]) -> ParameterError:
    if name == "render":
        return ParameterError(name, value, 'nothing: there is no such parameter; use render_mode="human"')
    if name in _ONLY_WITH:
        other, own = (text.replace("_", "-") for text in (_ONLY_WITH[name], control))
        return ParameterError(
            name, value, f"nothing here: it belongs to {other} environments, this one is {own}"
        )
    near = difflib.get_close_matches(name, checks, n=1, cutoff=0.0)[0]
    return ParameterError(name, value, f"nothing: there is no such parameter; the nearest is {near!r}")


class _Refused(Exception):
    """Carries what a parameter takes to where its name is known."""


def _checked(name: str, check: Check, value: Any) -> Any:
    try:
        return check(value)
    except _Refused as refused:
        raise ParameterError(name, value, str(refused)) from None


def _choice(*choices: Any) -> Check:
    def check(value: Any) -> Any:
        plain = value.item() if isinstance(value, np.generic) else value
        if not any(type(plain) is type(choice) and plain == choice for choice in choices):
            raise _Refused("one of " + ", ".join(repr(choice) for choice in choices))
        return plain

    return check


def _robot(names: Sequence[str]) -> Check:
    def check(value: Any) -> str:
        if value in names or (isinstance(value, str) and ":" in value):
            return str(value)
        raise _Refused("one of " + ", ".join(repr(name) for name in names) + ", or 'module:name' of your own")

    return check


def _integer(low: int, high: int | None = None) -> Check:
    def check(value: Any) -> int:
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or value < low or (high is not None and value > high):
            raise _Refused(f"an integer of at least {low}" + (f" and at most {high}" if high else ""))
        return int(value)

    return check


def _optional(inner: Check) -> Check:
    return lambda value: None if value is None else inner(value)


def _boolean(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise _Refused("True or False")
    return bool(value)


def _tray(use: TrayUse) -> Check:
    def check(value: Any) -> bool:
        if _boolean(value) not in use.choices:
            raise _Refused(f"{use.choices[0]} with this task: {use.reason}")
        return bool(value)

    return check


def _folder(value: Any) -> str:
    if not isinstance(value, str | os.PathLike) or not os.path.isdir(value):
        raise _Refused("None or a folder of OBJ or URDF files")
    return os.fspath(value)


def _no_object_set(value: Any) -> None:
    if value is not None:
        raise _Refused("None with this task: its objects are its own")


def _import_path(value: Any) -> str:
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise _Refused('None or "module:function"')
    return str(value)


def _images_only(value: Any) -> str:
    if value != "image":
        raise _Refused("'image' here: 'state' belongs to close-loop environments")
    return "image"


SEQUENCES = {CLOSE_LOOP: ("pxyz", "pxyzr"), OPEN_LOOP: ("xy", "xyr", "xyzrrr", "pxy", "pxyr", "pxyzrrr")}
"""What an action can consist of, a character a number, in any order (paper, Environment)."""


def _sequence(control: str) -> Check:
    def check(value: Any) -> str:
        known = SEQUENCES[control]
        if not isinstance(value, str) or sorted(value) not in [sorted(sequence) for sequence in known]:
            raise _Refused(
                f"{', '.join(map(repr, known[:-1]))} or {known[-1]!r}, their characters in any order"
            )
        return value

    return check


def _numbers(value: Any, shape: tuple[int, ...], takes: str) -> Any:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise _Refused(takes) from None
    if array.shape != shape or not np.isfinite(array).all():
        raise _Refused(takes)
    return array.tolist()


def _workspace(value: Any) -> list[list[float]]:
    takes = (
        "[[x low, x high], [y low, y high], [z low, z high]] in metres, square in x and y with sides "
        f"of at least {SMALLEST_WORKSPACE}, z low not below 0"
    )
    limits: list[list[float]] = _numbers(value, (3, 2), takes)
    x, y, z = (high - low for low, high in limits)
    if not (x >= SMALLEST_WORKSPACE and math.isclose(x, y, abs_tol=1e-9) and z > 0.0 and limits[2][0] >= 0.0):
        raise _Refused(takes)
    return limits


def _scale_range(value: Any) -> list[float]:
    takes = f"a positive number or [low, high], at most {LARGEST_SCALE}"
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    pair = [value, value] if is_number else value
    limits: list[float] = _numbers(pair, (2,), takes)
    if not 0.0 < limits[0] <= limits[1] <= LARGEST_SCALE:
        raise _Refused(takes)
    return limits


PARAMETERS = tuple(entry.name for entry in fields(EnvConfig) if entry.name != "control")
"""Names of all parameters."""
