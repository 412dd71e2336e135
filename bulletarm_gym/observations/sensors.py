"""The sensors of an environment by name."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, ParameterError
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations.camera_sensors import Depth, PointCloud, Rgb
from bulletarm_gym.observations.cameras import RENDER, SceneCamera, render_camera
from bulletarm_gym.observations.images import Color, Heightmap, InHand, Segmentation
from bulletarm_gym.observations.view import View
from bulletarm_gym.registry import SENSORS as REGISTRY
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera

OBJECT_SIZE = 8
"""Numbers of an object in the state: presence, position, quaternion."""
GRIPPER_SIZE = 6
"""Numbers of the gripper in the state."""


class Sensor(ABC):
    """One entry of the observation.

    A sensor changes nothing. Its reading follows from the scene and :attr:`memory`, so that states can be
    saved and restored. A subclass may have parameters, which the list of sensors sets by name to JSON values.

    :param scene: scene with all bodies loaded, before the first arrangement
    """

    controls: ClassVar[tuple[str, ...]] = (CLOSE_LOOP, OPEN_LOOP)
    """Names of the controls that the sensor works with."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.memory: Any = None
        """Memory within an episode, part of the state: plain values or bytes; None at the start."""

    @property
    @abstractmethod
    def space(self) -> spaces.Box:
        """Shape, type and bounds of the arrays that :meth:`read` returns."""

    @abstractmethod
    def read(self, view: View) -> NDArray[Any]:
        """Return the reading, a new array.

        :param view: view of the scene from above, rendered once for all sensors
        """

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras of the sensor at present, by the suffix of their names; by default none."""
        return {}

    def follow(self, before: View, pick: Pose | None) -> None:  # noqa: B027 (most have no memory)
        """Update :attr:`memory` after an action that was not ignored.

        :param before: view before the action; its labels can no longer be read
        :param pick: target pose of the fingertips, if the action was an open-loop pick
        """

    @property
    def follows(self) -> bool:
        """Return True if the sensor defines :meth:`follow`."""
        return type(self).follow is not Sensor.follow


class Holding(Sensor):
    """1 while the gripper holds an object, else 0."""

    @property
    def space(self) -> spaces.Box:
        """One number from 0 to 1."""
        return spaces.Box(0.0, 1.0, (1,), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return 1 while the gripper holds an object, else 0."""
        return np.array([view.is_holding], dtype=np.float32)


class JointState(Sensor):
    """Joint positions of the arm and opening of the gripper."""

    @property
    def space(self) -> spaces.Box:
        """Radians and a ratio, without bounds."""
        return spaces.Box(-np.inf, np.inf, (len(self.scene.robot.joint_positions) + 1,), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return the joint positions (rad), from the base on, and the opening ratio, 0 closed to 1 open."""
        robot = self.scene.robot
        return np.array([*robot.joint_positions, robot.opening_ratio], dtype=np.float32)


class State(Sensor):
    """Poses of the gripper and the objects."""

    controls = (CLOSE_LOOP,)

    @property
    def space(self) -> spaces.Box:
        """Metres and quaternions, without bounds."""
        size = GRIPPER_SIZE + sum(OBJECT_SIZE + len(obj.spec.parts) for obj in self.scene.objects)
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return the state.

        It begins with the opening ratio, position (m), and cosine and sine of the yaw of the gripper. For
        each object follow 1, its position (m) and its quaternion, or zeros if it is absent, and the positions
        (m or rad) of its joints.
        """
        robot = self.scene.robot
        tcp_pose = robot.pose
        numbers = [robot.opening_ratio, *tcp_pose.position, math.cos(tcp_pose.yaw), math.sin(tcp_pose.yaw)]
        for obj in self.scene.objects:
            pose = obj.pose
            numbers += [1.0, *pose.position, *pose.orientation] if obj.is_present else [0.0] * OBJECT_SIZE
            numbers += obj.joints if obj.spec.parts else ()
        return np.array(numbers, dtype=np.float32)


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
        self.follows = any(sensor.follows for sensor in self._sensors.values())
        self.space = spaces.Dict({name: sensor.space for name, sensor in self._sensors.items()})
        render = render_camera(scene)
        self.cameras = {RENDER: SceneCamera(lambda: render, scene.world)}
        """The camera ``"render"``, and the cameras of sensors by the names of the sensors."""
        for name, sensor in self._sensors.items():
            for suffix in sensor.cameras:
                if name + suffix in self.cameras:
                    must = f"sensors with other names: two cameras would be called {name + suffix!r}"
                    raise ParameterError.of("observation", config.observation, must)
                self.cameras[name + suffix] = SceneCamera(partial(_camera, sensor, suffix), scene.world)

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


def _camera(sensor: Sensor, suffix: str) -> Camera:
    return sensor.cameras[suffix]


def _make(config: EnvConfig, name: str, source: str, parameters: Mapping[str, Any], scene: Scene) -> Sensor:
    """Return a sensor.

    :param source: name of the sensor or its import path
    :raises ParameterError: the sensor is unknown, does not fit, or has wrong parameters
    """
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
