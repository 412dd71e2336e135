"""Tests whether a robot touches anything, without simulation."""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.geometry import Pose, matrix, rotate
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.simulation.world import NEAR

FREE_CLEARANCE = 0.004
"""Gap (m) that must stay between the robot and everything else where it moves without simulation."""
CLEAR_ABOVE = 0.01
"""Height (m) of a path above a body from which the path is free: joint motions sag some mm below a line."""

GRIP_ALIGNMENT = 0.7
"""Minimum cosine between a contact's normal and the fingers' direction for the contact to be a grip."""
GRIP_DISTANCE = 2e-3
"""Gap (m) up to which a finger touches."""


class Clearance:
    """Gaps between a robot and the other bodies of its world.

    :param world: the world
    :param robot: the robot's body
    :param gripper: its gripper
    """

    def __init__(self, world: World, robot: Body, gripper: Gripper) -> None:
        self._world = world
        self._robot = robot
        self._gripper = gripper

    @property
    def can_be_tested(self) -> bool:
        """True if no body moves or has yet to come to rest."""
        return not self._world.unsettled and not self._world.has_motion

    def bodies_above(self, height: float) -> list[Body]:
        """Return the bodies that reach above a height (m)."""
        return [body for body in self._world.obstacles if self._world.top(body) > height]

    def is_free(self, samples: Iterable[Sequence[float]], bodies: Sequence[Body]) -> bool:
        """Return True if the robot touches none of some bodies at any of some joint positions (m or rad)."""
        free = not bodies or all(self._is_free(sample, bodies) for sample in samples)
        self._world.set_joints(self._robot, self._world.joints[self._robot.index])
        return free

    def _is_free(self, joints: Sequence[float], bodies: Sequence[Body]) -> bool:
        self._world.show_joints(self._robot, joints)
        return not any(self._is_near(self._robot, body) for body in bodies)

    def _is_near(self, mover: Body, body: Body) -> bool:
        return not math.isinf(self._world.distance(mover, body, FREE_CLEARANCE))

    def is_apart(self, pose: Pose, held: Body | None) -> bool:
        """Return True if the robot and the grasped object touch nothing else.

        :param pose: of the fingertips
        :param held: the grasped object
        """
        lowest = self._gripper.lowest(pose)
        if held is not None:
            place = self._world.poses[held.index]
            lowest = min(lowest, place.z + float((held.spec.mesh.vertices @ matrix(place)[2]).min()))
        if lowest <= FREE_CLEARANCE:
            return False
        movers = [self._robot] if held is None else [self._robot, held]
        others = [body for body in self.bodies_above(lowest - FREE_CLEARANCE) if body is not held]
        return not any(self._is_near(mover, body) for body in others for mover in movers)

    def touched(self, pose: Pose, held: Body | None, bodies: Sequence[Body]) -> list[Body]:
        """Return those of some bodies that the robot, its fingertips at a pose, holds or touches."""
        low = self._gripper.lowest(pose) - CLEAR_ABOVE
        near = (body for body in bodies if self._world.top(body) > low)
        return [body for body in near if body is held or self._world.are_near(self._robot, body, NEAR)]

    def presses(self, finger: int, body: Body, tips: Pose) -> bool:
        """Return True if a finger's inner side presses on a body.

        Contacts tell which bodies to look at, but keep normals from before a turn; the gap is measured anew.

        :param finger: index of its joint
        :param tips: pose of the fingertips
        """
        client = self._world.client
        if not client.getContactPoints(self._robot.id, body.id, finger):
            return False
        points = client.getClosestPoints(self._robot.id, body.id, GRIP_DISTANCE, finger)
        x, y, z = rotate(tips.orientation, (1.0, 0.0, 0.0))
        return any(abs(p[7][0] * x + p[7][1] * y + p[7][2] * z) > GRIP_ALIGNMENT for p in points)
