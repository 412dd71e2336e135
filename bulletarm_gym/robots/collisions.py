"""Collision tests of a robot without simulation, and shifts that end penetrations.

Rigid bodies in Bullet penetrate each other where they press on each other.
"""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.geometry import Pose, Vector, matrix, rotate
from bulletarm_gym.robots.arm import Arm
from bulletarm_gym.simulation import Body, Contact
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


class CollidingArm(Arm):
    """An arm with collision tests of itself and its grasped object."""

    def touched(self, bodies: Sequence[Body]) -> list[Body]:
        """Return the bodies that the robot holds or touches."""
        low = self.model.gripper.lowest(self.pose) - CLEAR_ABOVE
        near = (body for body in bodies if self.world.top(body) > low)
        return [body for body in near if body is self.held or self.world.are_near(self.body, body, NEAR)]

    def is_apart(self) -> bool:
        """Return True if the robot and the grasped object touch no other body."""
        lowest, held = self.model.gripper.lowest(self.pose), self.held
        if held is not None:
            place = self.world.poses[held.index]
            lowest = min(lowest, place.z + float((held.spec.mesh.vertices @ matrix(place)[2]).min()))
        if lowest <= FREE_CLEARANCE:
            return False
        others = [body for body in self._bodies_above(lowest - FREE_CLEARANCE) if body is not held]
        return not any(self._is_near(mover, body) for body in others for mover in self._movers)

    def is_free_at(self, pose: Pose, bodies: Sequence[Body]) -> bool:
        """Return True if the robot at a pose in reach would touch none of some bodies."""
        return self._is_free([self._arm.moved(self.world, self._solve(pose))], bodies)

    def _is_free(self, samples: Iterable[Sequence[float]], bodies: Sequence[Body]) -> bool:
        """Return True if the robot touches none of some bodies at all samples of its joint positions."""
        free = not bodies or all(self._is_free_with(sample, bodies) for sample in samples)
        self.world.set_joints(self.body, self.world.joints[self.body.index])
        return free

    def _is_free_with(self, joints: Sequence[float], bodies: Sequence[Body]) -> bool:
        self.world.show_joints(self.body, joints)
        return not any(self._is_near(self.body, body) for body in bodies)

    def _is_near(self, mover: Body, body: Body) -> bool:
        return not math.isinf(self.world.distance(mover, body, FREE_CLEARANCE))

    def _bodies_above(self, height: float) -> list[Body]:
        return [body for body in self.world.obstacles if self.world.top(body) > height]

    @property
    def _movers(self) -> list[Body]:
        return [self.body] if self.held is None else [self.body, self.held]

    @property
    def _can_skip_simulation(self) -> bool:
        """Whether the gripper is empty and all bodies are at rest."""
        return self.held is None and not self.world.unsettled and not self.world.has_motion

    def _grips(self, body: Body) -> bool:
        """Return True if the inner sides of both fingers press on a body.

        Contacts of the last step show whether there is a force. Their normals may be older than a rotation.
        """
        x, y, z = rotate(self.pose.orientation, (1.0, 0.0, 0.0))
        for finger in self.finger_links:
            if not self.world.contacts(self.body, body, finger):
                return False
            points = self.world.closest_points(self.body, body, GRIP_DISTANCE, finger)
            normals = [point.normal for point in points]
            if not any(abs(n[0] * x + n[1] * y + n[2] * z) > GRIP_ALIGNMENT for n in normals):
                return False
        return True

    # Penetrations

    def _penetrated(self, mover: Body) -> list[Body]:
        """Return the bodies that a body penetrated in the last simulation step."""
        found = {c.other.index for c in self.world.contacts(mover) if c.distance < -REMAINING_DEPTH}
        return [self.world.bodies[index] for index in sorted(found)]

    def _shift(self) -> Vector | None:
        """Return the shift (m) of the robot with the grasped object out of the deepest penetration, or None.

        Penetrations between the two do not count.
        """
        points = [
            point
            for mover in self._movers
            for other in self._penetrated(mover)
            if other not in self._movers
            for point in self.world.closest_points(mover, other)
        ]
        deepest = _deepest(points)
        return None if deepest is None else _along(deepest, -deepest.distance - REMAINING_DEPTH)

    def _push_out(self) -> bool:
        """Move the grasped object out of a finger; return True if it is too deep in neither finger."""
        held = self.held
        for _ in range(MAX_SHIFTS):
            if held is None or (shift := self._held_shift(held)) is None:
                return True
            self.world.carry(held, Pose(shift).compose(self.world.poses[held.index]))
        return False

    def _held_shift(self, held: Body) -> Vector | None:
        """Return the shift (m) of the grasped object out of the finger that it is too deep in, or None.

        It is at most half of the depth, because the other finger is opposite.
        """
        deepest = _deepest(self.world.closest_points(self.body, held))
        pressed = any(c.distance < -MAX_DEPTH for c in self.world.contacts(self.body, held))
        if deepest is None or not (pressed or -deepest.distance > MAX_HELD_DEPTH):
            return None
        return _along(deepest, max(MAX_DEPTH + deepest.distance, deepest.distance / 2.0))

    def _missing_opening(self) -> float:
        """Return the distance (m) by which the fingers must open so that no body is too deep in both."""
        widths = [0.0]
        for other in self._penetrated(self.body):
            sides = [self.world.closest_points(self.body, other, 0.0, f) for f in self.finger_links]
            left = MAX_DEPTH if other is self.held else REMAINING_DEPTH
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
