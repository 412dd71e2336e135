"""Interface of a sensor, and the sensors without images: grasp, poses and joints."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations.view import View
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
        size = GRIPPER_SIZE + sum(OBJECT_SIZE + len(obj.spec.parts) for obj in self.scene.all_objects)
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
        for obj in self.scene.all_objects:
            pose = obj.pose
            numbers += [1.0, *pose.position, *pose.orientation] if obj.is_present else [0.0] * OBJECT_SIZE
            numbers += obj.joints if obj.spec.parts else ()
        return np.array(numbers, dtype=np.float32)
