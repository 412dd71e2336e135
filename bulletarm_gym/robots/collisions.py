"""Collision tests of a robot without simulation, and shifts that end penetrations.

Rigid bodies in Bullet penetrate each other where they press on each other.
"""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.geometry import Pose, Vector, matrix, rotate
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.simulation import Body, Contact, World
from bulletarm_gym.simulation.motion import MAX_DEPTH
from bulletarm_gym.simulation.world import NEAR

FREE_CLEARANCE = 0.004
"""Minimum gap (m) between the robot and all other bodies in motions without simulation."""
CLEAR_ABOVE = 0.01
"""Height (m) of a straight path above a body from which the joint motion is free: it sags by some mm."""
GRIP_ALIGNMENT = 0.7
"""Minimum cosine between the contact normal and the fingers' opening direction in a grasp."""
GRIP_DISTANCE = 2e-3
"""Maximum gap (m) between a finger and the grasped object."""
MAX_HELD_DEPTH = 3e-3
"""Depth (m) of the grasped object in a finger above which it is moved, even if no force presses it."""
REMAINING_DEPTH = 1e-3
"""Penetration (m) that remains, so that the bodies stay in contact."""
MAX_SHIFTS = 4
"""Maximum number of shifts out of penetrations. A shift out of one body may lead into another one."""


class Collisions:
    """Collision tests of a robot.

    :param robot: the robot's body
    """

    def __init__(self, world: World, robot: Body, gripper: Gripper) -> None:
        self._world = world
        self._robot = robot
        self._gripper = gripper

    @property
    def is_static(self) -> bool:
        """Whether all bodies are at rest, as the tests require."""
        return not self._world.unsettled and not self._world.has_motion

    def bodies_above(self, height: float) -> list[Body]:
        """Return the bodies that extend above a height (m)."""
        return [body for body in self._world.obstacles if self._world.top(body) > height]

    def is_free(self, samples: Iterable[Sequence[float]], bodies: Sequence[Body]) -> bool:
        """Return True if the robot touches none of some bodies at all samples of its joint positions."""
        free = not bodies or all(self._is_free(sample, bodies) for sample in samples)
        self._world.set_joints(self._robot, self._world.joints[self._robot.index])
        return free

    def _is_free(self, joints: Sequence[float], bodies: Sequence[Body]) -> bool:
        self._world.show_joints(self._robot, joints)
        return not any(self._is_near(self._robot, body) for body in bodies)

    def _is_near(self, mover: Body, body: Body) -> bool:
        return not math.isinf(self._world.distance(mover, body, FREE_CLEARANCE))

    def is_apart(self, pose: Pose, held: Body | None) -> bool:
        """Return True if the robot and the grasped object touch no other body.

        :param pose: tool pose
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
        """Return the bodies that the robot holds or touches at a tool pose."""
        low = self._gripper.lowest(pose) - CLEAR_ABOVE
        near = (body for body in bodies if self._world.top(body) > low)
        return [body for body in near if body is held or self._world.are_near(self._robot, body, NEAR)]

    def presses(self, finger: int, body: Body, tool: Pose) -> bool:
        """Return True if the inner side of a finger presses on a body.

        Contacts of the last step show whether there is a force. Their normals may be older than a rotation.

        :param finger: index of the finger's joint in Bullet
        :param tool: tool pose
        """
        if not self._world.contacts(self._robot, body, finger):
            return False
        points = self._world.closest_points(self._robot, body, GRIP_DISTANCE, finger)
        x, y, z = rotate(tool.orientation, (1.0, 0.0, 0.0))
        normals = [point.normal for point in points]
        return any(abs(n[0] * x + n[1] * y + n[2] * z) > GRIP_ALIGNMENT for n in normals)

    # Penetrations

    def shift_out(self, held: Body | None) -> Vector | None:
        """Return the shift (m) of the robot with the grasped object out of the deepest penetration.

        The result is None if no penetration is too deep. Those between the two do not count.
        """
        movers = [self._robot] if held is None else [self._robot, held]
        points = [
            point
            for mover in movers
            for other in self._penetrated(mover)
            if other not in movers
            for point in self._world.closest_points(mover, other)
        ]
        deepest = _deepest(points)
        return None if deepest is None else _along(deepest, -deepest.distance - REMAINING_DEPTH)

    def _penetrated(self, mover: Body) -> list[Body]:
        """Return the bodies that a body penetrated in the last simulation step."""
        found = {c.other.index for c in self._world.contacts(mover) if c.distance < -REMAINING_DEPTH}
        return [self._world.bodies[index] for index in sorted(found)]

    def push_out(self, held: Body | None) -> bool:
        """Move the grasped object out of a finger; return True if it is too deep in neither finger."""
        for _ in range(MAX_SHIFTS):
            if held is None or (shift := self._held_shift(held)) is None:
                return True
            self._world.carry(held, Pose(shift).compose(self._world.poses[held.index]))
        return False

    def _held_shift(self, held: Body) -> Vector | None:
        """Return the shift (m) of the grasped object out of the finger that it is too deep in, or None.

        It is at most half of the depth, because the other finger is opposite.
        """
        deepest = _deepest(self._world.closest_points(self._robot, held))
        pressed = any(c.distance < -MAX_DEPTH for c in self._world.contacts(self._robot, held))
        if deepest is None or not (pressed or -deepest.distance > MAX_HELD_DEPTH):
            return None
        return _along(deepest, max(MAX_DEPTH + deepest.distance, deepest.distance / 2.0))

    def missing_opening(self, fingers: Sequence[int], held: Body | None) -> float:
        """Return the distance (m) by which the fingers must open so that no body is too deep in both.

        :param fingers: indices of the finger joints in Bullet
        """
        widths = [0.0]
        for other in self._penetrated(self._robot):
            sides = [self._world.closest_points(self._robot, other, 0.0, finger) for finger in fingers]
            left = MAX_DEPTH if other is held else REMAINING_DEPTH
            if all(sides):
                depth = -sum(min(point.distance for point in side) for side in sides)
                widths.append(depth - len(sides) * left)
        return max(widths)


def _deepest(points: Sequence[Contact]) -> Contact | None:
    """Return the deepest point if it is too deep."""
    deepest = min(points, key=lambda point: point.distance, default=None)
    return None if deepest is None or -deepest.distance <= MAX_DEPTH else deepest


def _along(point: Contact, shift: float) -> Vector:
    """Return a shift (m) along the normal of a contact, out of the other body."""
    x, y, z = point.normal
    return (x * shift, y * shift, z * shift)
