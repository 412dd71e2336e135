"""Sensors without images: grasp, poses and joints."""

import math

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP
from bulletarm_gym.observations.sensor import Sensor
from bulletarm_gym.observations.view import View

OBJECT_SIZE = 8
"""Numbers of an object in the state: presence, position, quaternion."""
GRIPPER_SIZE = 6
"""Numbers of the gripper in the state."""


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
