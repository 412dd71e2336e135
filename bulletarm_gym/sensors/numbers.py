"""What is told in numbers: whether something is held, and where everything is."""

import math

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import View

POSE_SIZE = 8
"""Numbers an item has in the state: presence, position, quaternion."""
HAND_SIZE = 6
"""Numbers the gripper has in the state."""


class Holding(Sensor):
    """Whether the gripper holds something."""

    @property
    def space(self) -> spaces.Box:
        """One number from 0 to 1."""
        return spaces.Box(0.0, 1.0, (1,), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return 1 while the gripper holds something, else 0."""
        return np.array([view.is_holding], dtype=np.float32)


class State(Sensor):
    """The poses of gripper and items."""

    controls = (CLOSE_LOOP,)

    @property
    def space(self) -> spaces.Box:
        """Metres and quaternions, without limits."""
        size = HAND_SIZE + sum(POSE_SIZE + len(item.spec.parts) for item in self.scene.objects)
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return of the gripper opening ratio, position (m), cosine and sine of the yaw.

        Then for each item 1 if it is present, its position (m) and its quaternion; zeros if it is not; and
        the position (m or rad) of each of its parts that slide or turn.
        """
        robot = self.scene.robot
        hand = robot.pose
        numbers = [robot.opening_ratio, *hand.position, math.cos(hand.yaw), math.sin(hand.yaw)]
        for item in self.scene.objects:
            pose = item.pose
            numbers += [1.0, *pose.position, *pose.orientation] if item.is_present else [0.0] * POSE_SIZE
            numbers += item.joints if item.spec.parts else ()
        return np.array(numbers, dtype=np.float32)
