"""The sensors of an environment by name."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import EnvConfig, ParameterError
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations.camera_sensors import Depth, PointCloud, Rgb
from bulletarm_gym.observations.cameras import RENDER, SceneCamera, render_camera
from bulletarm_gym.observations.images import Color, Heightmap, InHand, Segmentation
from bulletarm_gym.observations.sensor import Holding, JointState, Sensor, State
from bulletarm_gym.observations.view import View
from bulletarm_gym.registry import SENSORS as REGISTRY
from bulletarm_gym.scene import Scene

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

    :raises ParameterError: a sensor is unknown, does not fit the control or the view, or has wrong parameters
    """

    def __init__(self, config: EnvConfig, scene: Scene) -> None:
        self._sensors = {
            name: _make(config, name, source, parameters, scene)
            for name, source, parameters in config.sensors
        }
        self.follows = any(type(one).follow is not Sensor.follow for one in self._sensors.values())
        self.space = spaces.Dict({name: sensor.space for name, sensor in self._sensors.items()})
        render = render_camera(scene)
        self.cameras = {RENDER: SceneCamera(lambda: render, scene.world)}
        """The camera ``"render"``, and the cameras of sensors by the names of the sensors."""
        for name, sensor in self._sensors.items():
            for suffix in sensor.cameras:
                if name + suffix in self.cameras:
                    must = f"sensors with other names: two cameras would be called {name + suffix!r}"
                    raise ParameterError.of("observation", config.observation, must)
                look = partial(lambda sensor, suffix: sensor.cameras[suffix], sensor, suffix)
                self.cameras[name + suffix] = SceneCamera(look, scene.world)

    def read(self, view: View) -> dict[str, NDArray[Any]]:
        """Return the observation, or raise ValueError if a sensor does not return an array of its space."""
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


def _make(config: EnvConfig, name: str, source: str, parameters: Mapping[str, Any], scene: Scene) -> Sensor:
    """Return a sensor, or raise ParameterError if it is unknown, does not fit, or has wrong parameters."""
    kind = REGISTRY.find(source, "observation")
    if config.control not in kind.controls:
        must = f"sensors of {config.control}, without {name!r} of {' and '.join(kind.controls)}"
        raise ParameterError.of("observation", config.observation, must)
    try:
        made: Sensor = kind(scene, **parameters)
        space = made.space
    except (TypeError, ValueError) as error:
        raise ParameterError(f"observation: {name}: {error}") from error
    if not isinstance(space, spaces.Box):
        raise ParameterError(f"observation: {name}: space must be a Box, got {space}")
    return made


def _checked(name: str, found: Any, space: spaces.Space[Any]) -> NDArray[Any]:
    """Return the reading of a sensor if it is an array with the shape and type of its space."""
    got = (getattr(found, "dtype", None), getattr(found, "shape", None))
    if got != (space.dtype, space.shape) or not isinstance(found, np.ndarray):
        raise ValueError(
            f"observation: {name}: read() must return an array of {space.dtype} of the shape {space.shape}, "
            f"got {type(found).__name__} {got[0]} {got[1]}"
        )
    return found
