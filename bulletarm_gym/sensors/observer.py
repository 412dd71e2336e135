"""The sensors of an environment, by the names that the user gave."""

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.cameras import RENDER
from bulletarm_gym.config import ORTHOGRAPHIC, EnvConfig, ParameterError
from bulletarm_gym.geometry import Pose
from bulletarm_gym.registry import SENSORS as REGISTRY
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors.cameras import PointCloud, Rgb
from bulletarm_gym.sensors.images import Color, Heightmap, Segmentation
from bulletarm_gym.sensors.in_hand import InHand
from bulletarm_gym.sensors.numbers import Holding, State
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import View
from bulletarm_gym.simulation import Camera

SENSORS: dict[str, type[Sensor]] = {
    "heightmap": Heightmap,
    "in_hand": InHand,
    "holding": Holding,
    "state": State,
    "color": Color,
    "segmentation": Segmentation,
    "rgb": Rgb,
    "point_cloud": PointCloud,
}
"""Built-in sensors, by name."""


class Observer:
    """Makes observations: a Dict of what each sensor reads.

    :param config: its ``observation`` says which
    :param scene: what they look at
    :raises ParameterError: a sensor does not fit the control or the other parameters, its parameters are
        wrong, or it is none
    """

    def __init__(self, config: EnvConfig, scene: Scene) -> None:
        self._sensors = {
            name: _made(config, name, source, parameters, scene)
            for name, source, parameters in config.sensors
        }
        self.asks_for_labels = any(sensor.asks_for_labels for sensor in self._sensors.values())
        self.follows = any(sensor.follows for sensor in self._sensors.values())
        self.cameras = self._named_cameras(config)
        self.space = spaces.Dict({name: sensor.space for name, sensor in self._sensors.items()})

    def _named_cameras(self, config: EnvConfig) -> dict[str, Camera]:
        """Return the cameras of all sensors by name.

        :raises ParameterError: two cameras would have one name
        """
        found = [
            (name + suffix, camera)
            for name, sensor in self._sensors.items()
            for suffix, camera in sensor.cameras.items()
        ]
        names = [RENDER, *(name for name, _ in found)]
        if taken := sorted({name for name in names if names.count(name) > 1}):
            takes = f"sensors with other names: two cameras would be called {', '.join(map(repr, taken))}"
            raise ParameterError.of("observation", config.observation, takes)
        return dict(found)

    def read(self, view: View) -> dict[str, NDArray[Any]]:
        """Return the observation; it changes nothing.

        :raises ValueError: a sensor returns something else than an array of its space
        """
        return {
            name: _checked(name, sensor.read(view), self.space[name])
            for name, sensor in self._sensors.items()
        }

    def follow(self, before: View, pick: Pose | None) -> None:
        """Tell the sensors that an action was carried out."""
        for sensor in self._sensors.values():
            sensor.follow(before, pick)

    def get_memory(self) -> dict[str, Any]:
        """Return what sensors remember, by name; picklable."""
        return {name: s.memory for name, s in self._sensors.items() if s.memory is not None}

    def set_memory(self, memory: Mapping[str, Any]) -> None:
        """Have the sensors remember what others of their names did; the rest forgets."""
        for name, sensor in self._sensors.items():
            sensor.memory = memory.get(name)

    def shapes(self, names: Iterable[str]) -> dict[str, list[int]]:
        """Return the shapes of some of the sensors, of those that there are."""
        return {name: list(self._sensors[name].space.shape) for name in names if name in self._sensors}


def _made(config: EnvConfig, name: str, source: str, parameters: Mapping[str, Any], scene: Scene) -> Sensor:
    """Make a sensor.

    :raises ParameterError: it cannot be had so
    """
    kind = REGISTRY.find(source, "observation")
    if inspect.isabstract(kind):
        raise ParameterError.of("observation", config.observation, f"a list without the abstract {source!r}")
    if config.control not in kind.controls:
        belongs = " or ".join(control.replace("_", "-") for control in kind.controls)
        takes = f"what can be seen here: {name!r} belongs to {belongs} environments"
        raise ParameterError.of("observation", config.observation, takes)
    if kind.asks_for_labels and config.view != ORTHOGRAPHIC:
        takes = (
            f"sensors that view={config.view!r} has, not {name!r}: only {ORTHOGRAPHIC!r} tells bodies apart"
        )
        raise ParameterError.of("observation", config.observation, takes)
    _check_parameters(config, name, kind, parameters)
    try:
        made: Sensor = kind(scene, **parameters)
    except ValueError as error:
        raise ParameterError(f"observation: {name}: {error}") from error
    if not isinstance(made.space, spaces.Box):
        raise ParameterError(f"observation: {name}: space must be a Box, got {made.space}")
    return made


def _checked(name: str, found: Any, space: spaces.Space[Any]) -> NDArray[Any]:
    """Return what a sensor read, an array of the shape and the type of its space."""
    is_array = isinstance(found, np.ndarray)
    if not is_array or found.shape != space.shape or found.dtype != space.dtype:
        got = f"{found.dtype} of the shape {found.shape}" if is_array else type(found).__name__
        raise ValueError(
            f"observation: {name}: read() must return an array of {space.dtype} of the shape {space.shape}, "
            f"got {got}"
        )
    return found  # type: ignore[no-any-return]


def _check_parameters(
    config: EnvConfig, name: str, kind: type[Sensor], parameters: Mapping[str, Any]
) -> None:
    known = list(inspect.signature(kind).parameters)[1:]
    unknown = [parameter for parameter in parameters if parameter not in known]
    if unknown:
        takes = f"for {name!r} {', '.join(known) or 'no parameters'}, not {', '.join(unknown)}"
        raise ParameterError.of("observation", config.observation, takes)
