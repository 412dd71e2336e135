"""Ranges of physical, visual and sensor properties that are sampled at every reset."""
# ruff: noqa: RUF009 (quantity() returns a dataclasses.field())

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from bulletarm_gym.config_checks import ParameterError, Refused, check_argument, interval

Range = tuple[float, float]

OPEN_LOOP_SHARE = 0.2
"""Share of the presets' noise on actions in open-loop control, where the same number is a longer distance."""
AXES = ("_x", "_y", "_z")
"""Endings of the keys of a quantity with three components."""


def quantity(neutral: float, limits: Range, real: Range, endings: Sequence[str] = ("",)) -> Any:
    """Return the dataclass field of a sampled quantity.

    :param neutral: value without an effect, the default
    :param real: range in the preset ``"real"``
    :param endings: endings of the keys of its components
    """
    return field(default=(neutral, neutral), metadata={"limits": limits, "real": real, "endings": endings})


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges of values that are sampled uniformly at every reset.

    A range is [low, high] or a number. The default of each quantity has no effect. A reset that keeps the
    objects of the previous episode also keeps the values. Friction, mass and colour of the moving parts of
    objects do not change.

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

    # OpenAI et al. 2018 (arXiv 1808.00177, Table 1)
    object_friction: Range = quantity(1.0, (0.1, 10.0), (0.7, 1.3))
    surface_friction: Range = quantity(1.0, (0.1, 10.0), (0.7, 1.3))
    object_mass: Range = quantity(1.0, (0.1, 10.0), (0.5, 1.5))
    gripper_force: Range = quantity(1.0, (0.1, 10.0), (0.75, 1.5))
    joint_resistance: Range = quantity(1.0, (0.0, 10.0), (0.3, 3.0))
    # estimates
    camera_position: Range = quantity(0.0, (-0.1, 0.1), (-0.004, 0.004), AXES)
    camera_rotation: Range = quantity(0.0, (-0.2, 0.2), (-0.01, 0.01), AXES)
    # a Kinect at 1 m has a noise of 1.4 mm and a step of 2.9 mm (Khoshelham and Elberink 2012)
    depth_noise: Range = quantity(0.0, (0.0, 0.1), (0.0, 0.0015))
    depth_step: Range = quantity(0.0, (0.0, 0.1), (0.0, 0.003))
    # fill rate of 99 % in Intel's data sheet of the RealSense D400 series
    depth_missing: Range = quantity(0.0, (0.0, 0.9), (0.0, 0.01))
    # Handa et al. 2014
    depth_edges: Range = quantity(0.0, (0.0, 1.0), (0.0, 0.3))
    # estimates
    action_noise: Range = quantity(0.0, (0.0, 1.0), (0.0, 0.05))
    action_delay: Range = quantity(0.0, (0.0, 1.0), (0.0, 0.3))
    colour: Range = quantity(0.0, (0.0, 1.0), (0.0, 0.3))
    light_direction: Range = quantity(0.0, (-0.5, 0.5), (-0.5, 0.5), AXES)
    light_brightness: Range = quantity(1.0, (0.1, 3.0), (0.7, 1.3))

    def __post_init__(self) -> None:
        """Check the ranges and convert them to tuples."""
        for entry in fields(self):
            check = interval(*entry.metadata["limits"])
            ends = check_argument(entry.name, getattr(self, entry.name), check)
            object.__setattr__(self, entry.name, tuple(ends))

    @classmethod
    def of(cls, value: Any, is_open_loop: bool) -> "Randomization":
        """Return the ranges of a value of the parameter ``randomization``.

        :param value: None, the name of a preset, a mapping of names to ranges, or a Randomization
        :param is_open_loop: whether actions are picks and places, which have no delay
        :raises ValueError: the value is not valid
        """
        if isinstance(value, str) and value in PRESETS:
            preset = PRESETS[value]
            noise = (0.0, preset.action_noise[1] * OPEN_LOOP_SHARE)
            return replace(preset, action_delay=(0.0, 0.0), action_noise=noise) if is_open_loop else preset
        ranges = value.varied if isinstance(value, cls) else {} if value is None else value
        if not isinstance(ranges, Mapping) or not set(ranges) <= set(NAMES):
            presets = ", ".join(map(repr, PRESETS))
            raise Refused(f"None, {presets}, a Randomization or a dict with keys from {', '.join(NAMES)}")
        try:
            made = cls(**ranges)
            if is_open_loop and made.action_delay != (0.0, 0.0):
                raise ParameterError.of("action_delay", list(made.action_delay), "0 in open-loop control")
        except ParameterError as error:
            raise ParameterError(f"randomization: {error}") from None
        return made

    @property
    def varied(self) -> dict[str, list[float]]:
        """Ranges that differ from the default, by name."""
        changed = (entry.name for entry in fields(self) if getattr(self, entry.name) != entry.default)
        return {name: list(getattr(self, name)) for name in changed}

    def sample(self, rng: np.random.Generator, names: Sequence[str]) -> dict[str, float]:
        """Return a value for each component of some quantities, by key: the name, or name and axis."""
        return {
            entry.name + ending: float(rng.uniform(*getattr(self, entry.name)))
            for entry in fields(self)
            if entry.name in names
            for ending in entry.metadata["endings"]
        }


NAMES = tuple(entry.name for entry in fields(Randomization))
"""Names of the quantities."""


def _preset(share: float) -> Randomization:
    """Return ranges between the defaults (0) and the preset ``"real"`` (1)."""
    ranges: dict[str, Any] = {}
    for name, (neutral, _) in vars(Randomization()).items():
        real = Randomization.__dataclass_fields__[name].metadata["real"]
        ranges[name] = [(1.0 - share) * neutral + share * end for end in real]
    return Randomization(**ranges)


PRESETS = {"light": _preset(1.0 / 3.0), "real": _preset(1.0)}
"""Presets by name; ``"light"`` has a third of the deviations of ``"real"``."""


def json_ranges(value: Any, is_open_loop: bool) -> Any:
    """Return a valid value of the parameter ``randomization`` as None, a preset's name or a dict."""
    made = Randomization.of(value, is_open_loop)
    return value if value is None or isinstance(value, str) else made.varied
