"""The sensors of an environment by name."""

import inspect
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import ORTHOGRAPHIC, EnvConfig, ParameterError
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations.camera_sensors import Depth, PointCloud, Rgb
from bulletarm_gym.observations.cameras import RENDER, SceneCamera, render_camera
from bulletarm_gym.observations.images import Color, Heightmap, Segmentation
from bulletarm_gym.observations.in_hand import InHand
from bulletarm_gym.observations.sensor import Sensor
from bulletarm_gym.observations.state import Holding, JointState, State
from bulletarm_gym.observations.view import View
from bulletarm_gym.registry import SENSORS as REGISTRY
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera

SENSORS: dict[str, type[Sensor]] = {
    "heightmap": Heightmap,
    "in_hand": InHand,
    "holding": Holding,
    "state": State,
    "color": Color,
    "segmentation": Segmentation,
    "rgb": Rgb,
    "depth": Depth,
    "point_cloud": PointCloud,
    "joint_state": JointState,
}
"""Built-in sensors, by name."""


class Observer:
    """Reads the sensors that ``observation`` lists.

    :param config: the environment's parameters
    :param scene: scene that the sensors observe
    :raises ParameterError: a sensor is unknown, does not fit the control or the view, or has wrong parameters
    """

    def __init__(self, config: EnvConfig, scene: Scene) -> None:
        self._sensors = {
            name: _make(config, name, source, parameters, scene)
            for name, source, parameters in config.sensors
        }
        self.needs_labels = any(sensor.needs_labels for sensor in self._sensors.values())
        self.follows = any(sensor.follows for sensor in self._sensors.values())
        self.space = spaces.Dict({name: sensor.space for name, sensor in self._sensors.items()})
        found = [(name, suffix) for name, sensor in self._sensors.items() for suffix in sensor.cameras]
        names = [RENDER, *(name + suffix for name, suffix in found)]
        if taken := sorted({name for name in names if names.count(name) > 1}):
            takes = f"sensors with other names: two cameras would be called {', '.join(map(repr, taken))}"
            raise ParameterError.of("observation", config.observation, takes)
        render = render_camera(scene)
        self.cameras = {RENDER: SceneCamera(lambda: render, scene.world)}
        """The camera ``"render"``, and the cameras of sensors by the names of the sensors."""
        for name, suffix in found:
            self.cameras[name + suffix] = SceneCamera(partial(self._camera, name, suffix), scene.world)

    def _camera(self, name: str, suffix: str) -> Camera:
        return self._sensors[name].cameras[suffix]

    def read(self, view: View) -> dict[str, NDArray[Any]]:
        """Return the observation.

        :raises ValueError: a sensor does not return an array of its space
        """
        return {
            name: _checked(name, sensor.read(view), self.space[name])
            for name, sensor in self._sensors.items()
        }

    def follow(self, before: View, pick: Pose | None) -> None:
        """Update the memory of the sensors after an action, see :meth:`Sensor.follow`."""
        for sensor in self._sensors.values():
            sensor.follow(before, pick)

    def get_memory(self) -> dict[str, Any]:
        """Return the memory of the sensors that have one, by name; picklable."""
        return {name: s.memory for name, s in self._sensors.items() if s.memory is not None}

    def set_memory(self, memory: Mapping[str, Any]) -> None:
        """Set the memory of the sensors by name, None for the others."""
        for name, sensor in self._sensors.items():
            sensor.memory = memory.get(name)

    def shapes(self, names: Iterable[str]) -> dict[str, list[int]]:
        """Return the shapes of the named sensors that are part of the observation."""
        return {name: list(self._sensors[name].space.shape) for name in names if name in self._sensors}


def _make(config: EnvConfig, name: str, source: str, parameters: Mapping[str, Any], scene: Scene) -> Sensor:
    """Return a sensor.

    :param source: name of the sensor or its import path
    :raises ParameterError: the sensor is unknown, does not fit, or has wrong parameters
    """
    kind = REGISTRY.find(source, "observation")
    takes = _mismatch(config, name, source, kind, parameters)
    if takes is not None:
        raise ParameterError.of("observation", config.observation, takes)
    try:
        made: Sensor = kind(scene, **parameters)
    except ValueError as error:
        raise ParameterError(f"observation: {name}: {error}") from error
    if not isinstance(made.space, spaces.Box):
        raise ParameterError(f"observation: {name}: space must be a Box, got {made.space}")
    return made


def _mismatch(
    config: EnvConfig, name: str, source: str, kind: Any, parameters: Mapping[str, Any]
) -> str | None:
    """Return the constraint that a sensor violates, or None."""
    if inspect.isabstract(kind):
        return f"a list without the abstract {source!r}"
    if config.control not in kind.controls:
        belongs = " or ".join(control.replace("_", "-") for control in kind.controls)
        return f"what can be seen here: {name!r} belongs to {belongs} environments"
    if kind.needs_labels and config.view != ORTHOGRAPHIC:
        return (
            f"sensors that view={config.view!r} has, not {name!r}: only {ORTHOGRAPHIC!r} tells bodies apart"
        )
    known = list(inspect.signature(kind).parameters)[1:]
    unknown = [parameter for parameter in parameters if parameter not in known]
    if unknown:
        return f"for {name!r} {', '.join(known) or 'no parameters'}, not {', '.join(unknown)}"
    return None


def _checked(name: str, found: Any, space: spaces.Space[Any]) -> NDArray[Any]:
    """Return the reading of a sensor if it is an array with the shape and type of its space."""
    is_array = isinstance(found, np.ndarray)
    if not is_array or found.shape != space.shape or found.dtype != space.dtype:
        got = f"{found.dtype} of the shape {found.shape}" if is_array else type(found).__name__
        raise ValueError(
            f"observation: {name}: read() must return an array of {space.dtype} of the shape {space.shape}, "
            f"got {got}"
        )
    return found  # type: ignore[no-any-return]
