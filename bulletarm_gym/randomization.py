"""Ranges of physical, visual and sensor properties that are sampled at every reset."""
# ruff: noqa: RUF009 (quantity() returns a dataclasses.field())

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from bulletarm_gym.config_checks import Check, ParameterError, Refused, check_argument, interval

Range = tuple[float, float]

LIGHT_SHARE = 1.0 / 3.0
"""Share of the ranges of the preset ``"real"`` in the preset ``"light"``."""
OPEN_LOOP_SHARE = 0.2
"""Share of the presets' noise on actions in open-loop control, where the same number is a longer distance."""

AXES = ("_x", "_y", "_z")
"""Endings of the keys of a quantity with three components."""


def quantity(neutral: float, low: float, high: float, endings: Sequence[str] = ("",)) -> Any:
    """Return the dataclass field of a sampled quantity.

    :param neutral: value without an effect, the default
    :param low: smallest accepted value
    :param high: largest accepted value
    :param endings: endings of the keys of its components
    """
    return field(default=(neutral, neutral), metadata={"limits": (low, high), "endings": endings})


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges of values that are sampled uniformly at every reset.

    A range is [low, high] or a number. The default of each quantity has no effect.

    :param object_friction: factor on the friction coefficients of all objects
    :param surface_friction: factor on the friction coefficients of the surface
    :param object_mass: factor on the masses of all objects
    :param gripper_force: factor on the maximum force of the fingers
    :param joint_resistance: factor on the resistance of sliding and rotating parts of objects
    :param camera_position: calibration error (m) of cameras along each axis of the camera frame, and of
        orthographic heightmaps along each axis of the world
    :param camera_rotation: the same error (rad) about each axis; heightmaps rotate only about the vertical
    :param depth_noise: standard deviation (m) of normal noise on depths at a distance of 1 m; it grows with
        the square of the distance. Orthographic heightmaps have the noise of a camera 1 m above z = 0
    :param depth_step: difference (m) of neighbouring measurable depths at a distance of 1 m; it grows with
        the square of the distance
    :param depth_missing: fraction of squares of 4 x 4 pixels without a measurement. They are filled with the
        depth to the left of them
    :param depth_edges: fraction of pixels with the depth of an adjacent pixel, so that edges are ragged
    :param action_noise: standard deviation of normal noise on each number of an action except p, in units of
        the action space
    :param action_delay: fraction of each action that is replaced by this fraction of the previous action; 1
        delays actions by one step. Closed-loop control only
    :param colour: maximum change of red, green and blue, 0 to 1, of each object and surface
    :param light_direction: change of each component of the direction to the light of rendered images
    :param light_brightness: factor on the brightness of this light
    :raises ValueError: a range is not valid
    """

    object_friction: Range = quantity(1.0, 0.1, 10.0)
    surface_friction: Range = quantity(1.0, 0.1, 10.0)
    object_mass: Range = quantity(1.0, 0.1, 10.0)
    gripper_force: Range = quantity(1.0, 0.1, 10.0)
    joint_resistance: Range = quantity(1.0, 0.0, 10.0)
    camera_position: Range = quantity(0.0, -0.1, 0.1, AXES)
    camera_rotation: Range = quantity(0.0, -0.2, 0.2, AXES)
    depth_noise: Range = quantity(0.0, 0.0, 0.1)
    depth_step: Range = quantity(0.0, 0.0, 0.1)
    depth_missing: Range = quantity(0.0, 0.0, 0.9)
    depth_edges: Range = quantity(0.0, 0.0, 1.0)
    action_noise: Range = quantity(0.0, 0.0, 1.0)
    action_delay: Range = quantity(0.0, 0.0, 1.0)
    colour: Range = quantity(0.0, 0.0, 1.0)
    light_direction: Range = quantity(0.0, -0.5, 0.5, AXES)
    light_brightness: Range = quantity(1.0, 0.1, 3.0)

    def __post_init__(self) -> None:
        """Check the ranges and convert them to tuples."""
        for entry in fields(self):
            check = interval(*entry.metadata["limits"])
            object.__setattr__(
                self, entry.name, tuple(check_argument(entry.name, getattr(self, entry.name), check))
            )

    @classmethod
    def of(cls, value: Any, is_open_loop: bool) -> "Randomization":
        """Return the ranges of a value of the parameter ``randomization``.

        :param value: None, the name of a preset, a mapping of names to ranges, or a Randomization
        :param is_open_loop: whether actions are picks and places, which have no delay
        :raises ValueError: the value is not valid
        """
        if isinstance(value, str) and value in PRESETS:
            low, high = (end * OPEN_LOOP_SHARE for end in PRESETS[value].action_noise)
            preset = PRESETS[value]
            return replace(preset, action_delay=(0, 0), action_noise=(low, high)) if is_open_loop else preset
        if not (value is None or isinstance(value, Mapping | cls)):
            raise Refused(f"None, {', '.join(map(repr, PRESETS))}, a dict of ranges or a Randomization")
        ranges: Any = value or {}
        try:
            made = value if isinstance(value, cls) else cls(**ranges)
        except TypeError:
            raise Refused(f"a dict with keys from {', '.join(NAMES)}") from None
        except ParameterError as error:
            raise ParameterError(f"randomization: {error}") from None
        if is_open_loop and made.action_delay != (0.0, 0.0):
            got = list(made.action_delay)
            raise ParameterError(f"randomization: action_delay must be 0 in open-loop control, got {got}")
        return made

    @property
    def varied(self) -> dict[str, list[float]]:
        """Ranges that differ from the default, by name."""
        names = (entry.name for entry in fields(self) if getattr(self, entry.name) != entry.default)
        return {name: list(getattr(self, name)) for name in names}

    def shrunk(self, share: float) -> "Randomization":
        """Return ranges whose ends have a share of the present distance to the default."""
        neutral: dict[str, Any] = vars(Randomization())
        ends = {name: zip(neutral[name], getattr(self, name), strict=True) for name in NAMES}
        ranges = {name: [n + share * (end - n) for n, end in pairs] for name, pairs in ends.items()}
        return Randomization(**ranges)  # type: ignore[arg-type]

    def beyond(self, limits: "Randomization") -> str:
        """Return the first name of a quantity whose range is not inside that of ``limits``, or ``""``."""
        ranges = [(name, *getattr(self, name), *getattr(limits, name)) for name in NAMES]
        return next((name for name, low, high, least, most in ranges if low < least or most < high), "")

    def sample(self, rng: np.random.Generator, names: Sequence[str]) -> dict[str, float]:
        """Return a value for each component of some quantities, by key: the name, or name and axis."""
        return {
            name + ending: float(rng.uniform(*getattr(self, name)))
            for name in names
            for ending in ENDINGS[name]
        }


ENDINGS = {entry.name: entry.metadata["endings"] for entry in fields(Randomization)}
"""Endings of the keys of the components of each quantity, by name."""
NAMES = tuple(ENDINGS)
"""Names of the quantities."""


def randomization(is_open_loop: bool) -> Check:
    """Accept the values of the parameter ``randomization``; return None, a preset's name or a dict."""

    def check(value: Any) -> Any:
        made = Randomization.of(value, is_open_loop)
        return value if value is None or isinstance(value, str) else made.varied

    return check


REAL = Randomization(
    object_friction=(0.7, 1.3),
    surface_friction=(0.7, 1.3),
    object_mass=(0.5, 1.5),
    gripper_force=(0.75, 1.5),
    joint_resistance=(0.3, 3.0),
    camera_position=(-0.004, 0.004),
    camera_rotation=(-0.01, 0.01),
    depth_noise=(0.0, 0.0015),
    depth_step=(0.0, 0.003),
    depth_missing=(0.0, 0.01),
    depth_edges=(0.0, 0.3),
    action_noise=(0.0, 0.05),
    action_delay=(0.0, 0.3),
    colour=(0.0, 0.3),
    light_direction=(-0.5, 0.5),
    light_brightness=(0.7, 1.3),
)
"""Preset ``"real"``. Frictions, masses, forces and joints: OpenAI et al. 2018 (arXiv 1808.00177, Table 1).
Noise and step: a Kinect at 1 m has 1.4 and 2.9 mm (Khoshelham and Elberink 2012). Edges: Handa et al. 2014.
Missing pixels: the fill rate in Intel's data sheet of the RealSense D400 series is 99 %. The ranges of camera
poses, actions, colours and light are estimates."""
PRESETS = {"light": REAL.shrunk(LIGHT_SHARE), "real": REAL}
"""Presets by name."""
