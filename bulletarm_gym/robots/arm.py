"""The joints of a robot in a world: measurements and inverse kinematics."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from bulletarm_gym.geometry import Pose, Vector, conjugate, interpolate, matrix, multiply, rotate
from bulletarm_gym.geometry.poses import scaled
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.robots.model import Dynamics, RobotModel
from bulletarm_gym.simulation import Body, BodySpec, Contact, World
from bulletarm_gym.simulation.motion import MAX_DEPTH, JointGroup, add_gear_constraint
from bulletarm_gym.simulation.world import NEAR

YAW_RADIUS = 0.06
"""Distance (m) per rad of rotation about the tool's z axis: half an open gripper and its fingers."""
TILT_RADIUS = 0.25
"""Distance (m) per rad of tilt: from the fingertips to the wrist of an arm."""
MAX_SAG = 0.2
"""Maximum distance of a motion from the straight line relative to its length."""


def path_length(start: Pose, end: Pose) -> float:
    """Return the maximum distance (m) that fingertips, open fingers or wrist move between tool poses."""
    x, y, z, w = multiply(conjugate(start.orientation), end.orientation)
    yaw = 2.0 * math.atan2(abs(z), abs(w))
    tilt = 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w))
    return max(math.dist(start.position, end.position), YAW_RADIUS * yaw, TILT_RADIUS * tilt)


MAX_JOINT_CHANGE = math.pi
"""Change (rad) of a joint from which a motion is a detour around a joint limit."""
STRAIGHT_JOINT_CHANGE = 0.3
"""Change (rad) of all joints but the last below which a closed-loop step is almost straight."""
CACHE_SIZE = 64
"""Number of poses whose joint positions are cached. An action uses the same poses repeatedly."""


class OutOfReachError(ValueError):
    """Raised when inverse kinematics has no solution for a pose."""


class Arm:
    """An arm with its gripper, loaded into a world.

    Poses are tool poses in the world: between the fingertips, z upwards when the gripper points down, x along
    the opening direction.
    """

    def __init__(self, model: RobotModel, world: World) -> None:
        self.model = model
        self.world = world
        self.body = world.add_urdf(BodySpec(model.name, (), 0.0), model.xml, model.base)
        names = [link.joint for link in self.body.links]
        self._arm = JointGroup(self.body, tuple(names.index(name) for name in model.joints), model.torques)
        fingers = tuple(names.index(name) for name in model.gripper.joints)
        self._fingers = JointGroup(self.body, fingers, (model.gripper.force,) * 2)
        self.finger_links = self._fingers.joints
        """Indices of the finger links in Bullet."""
        add_gear_constraint(world, self._fingers, model.gripper.friction)
        self.dynamics = Dynamics(self.body, self._arm.joints, model.chain)
        self.held: Body | None = None
        self._inverse = lru_cache(maxsize=CACHE_SIZE)(model.inverse)
        self._forward = lru_cache(maxsize=1)(lambda joints: model.chain.forward(np.array(joints)))
        limits = np.nan_to_num(model.chain.solution_limits).tolist()  # finite, also of continuous joints
        self._wrist_limits: list[float] = limits[-1]
        self._turning_joints = [
            (j, low, high) for j, (low, high) in enumerate(limits) if high - low >= math.tau
        ]

    @property
    def pose(self) -> Pose:
        """Tool pose."""
        return self._forward(self.joint_positions)

    @property
    def joint_positions(self) -> tuple[float, ...]:
        """Positions (rad) of the arm joints, in the order of ``model.joints``."""
        return self._arm.positions(self.world)

    @property
    def joint_velocities(self) -> tuple[float, ...]:
        """Velocities (rad/s) of the arm joints in the state, 0 between actions."""
        rates = self.world.joint_rates[self.body.index]
        return tuple(rates[joint] for joint in self._arm.joints)

    @property
    def joint_torques(self) -> tuple[float, ...]:
        """Torques (N m) of the arm joints that hold the robot and the grasped object still."""
        still = np.zeros(len(self.joint_positions))
        torques = self.dynamics.torques(np.array(self.joint_positions), still, still, self._load)
        return tuple(torques.tolist())

    @property
    def camera_pose(self) -> Pose:
        """Pose of a wrist camera at the fingers' roots: z along the approach, x the opening direction."""
        height = self.model.gripper.finger[2]
        return self.pose.compose(Pose((0.0, 0.0, height), (1.0, 0.0, 0.0, 0.0)))

    @property
    def opening(self) -> float:
        """Distance (m) between the fingers."""
        return sum(self._fingers.positions(self.world))

    @property
    def opening_ratio(self) -> float:
        """Opening relative to the gripper's stroke, 0 closed to 1 open."""
        return min(1.0, max(0.0, self.opening / self.model.gripper.stroke))

    def set_force_factor(self, factor: float) -> None:
        """Set the maximum force of the fingers to that of the gripper times a factor."""
        self._fingers = replace(self._fingers, forces=(factor * self.model.gripper.force,) * 2)

    @property
    def _load(self) -> float:
        """Mass (kg) of the grasped object."""
        return 0.0 if self.held is None else self.world.get_properties(self.held).mass

    def show_joints(self, positions: Sequence[float]) -> None:
        """Set the arm joints (rad) for a query of the world, until the next motion begins."""
        self.world.show_joints(self.body, self._arm.moved(self.world, positions))

    def inverse_kinematics(self, pose: Pose) -> tuple[float, ...]:
        """Return joint positions (rad) inside the limits for a tool pose.

        Multiples of 2 pi are added to each joint, so that it is as near as possible to its current position.

        :raises OutOfReachError: no solution is inside the joint limits
        """
        solution = self._solve(pose)
        for joint, low, high in self._turning_joints:
            turns = round((self.joint_positions[joint] - solution[joint]) / math.tau)
            least = math.ceil((low - solution[joint]) / math.tau)
            most = math.floor((high - solution[joint]) / math.tau)
            solution[joint] += math.tau * min(max(turns, least), most)
        return tuple(solution)

    def _solve(self, pose: Pose) -> list[float]:
        joints, error = self._inverse(pose)
        if not error <= POSITION_TOLERANCE:  # it is NaN for a pose that is not finite
            raise OutOfReachError(f"robot {self.model.name!r} cannot reach {pose}, the error is {error:.4f}")
        solution: list[float] = joints.tolist()
        return solution

    def reaches(self, pose: Pose) -> bool:
        """Return True if a tool pose is in reach."""
        return self._inverse(pose)[1] <= POSITION_TOLERANCE

    def can_move_to(self, pose: Pose) -> bool:
        """Return True if one motion leads to a pose: in reach, no joint limit in between, almost straight.

        A motion away from the limits of the last joint may deviate from the line.
        """
        if not self.reaches(pose):
            return False
        goal = self.inverse_kinematics(pose)
        if np.abs(np.subtract(goal, self.joint_positions)).max() >= MAX_JOINT_CHANGE:
            return False
        return self._is_straight(pose, goal) or self.wrist_room(pose) > self.wrist_room()

    def _is_straight(self, pose: Pose, goal: Sequence[float]) -> bool:
        """Return True if the middle of a joint motion is near the straight line to a pose."""
        now = np.array(self.joint_positions)
        if np.abs(goal - now)[:-1].max() < STRAIGHT_JOINT_CHANGE:
            return True
        middle = self.model.chain.forward((now + goal) / 2.0)
        off = math.dist(middle.position, interpolate(self.pose, pose, 0.5).position)
        return off < MAX_SAG * path_length(self.pose, pose)

    def wrist_room(self, pose: Pose | None = None) -> float:
        """Return the distance (rad) of the last joint from its nearer limit, now or at a pose in reach."""
        joints = self.joint_positions if pose is None else self.inverse_kinematics(pose)
        low, high = self._wrist_limits
        return min(joints[-1] - low, high - joints[-1])


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
        movers = self._movers
        return not any(self.world.are_near(one, body, FREE_CLEARANCE) for body in others for one in movers)

    def is_free_at(self, pose: Pose, bodies: Sequence[Body]) -> bool:
        """Return True if the robot at a pose in reach would touch none of some bodies."""
        return self._is_free(self._arm, [self._solve(pose)], bodies)

    def _is_free(self, group: JointGroup, samples: Iterable[Sequence[float]], bodies: Sequence[Body]) -> bool:
        """Return True if the robot touches none of some bodies at all samples of a group's positions."""

        def is_free_with(positions: Sequence[float]) -> bool:
            self.world.show_joints(self.body, group.moved(self.world, positions))
            return not any(self.world.are_near(self.body, body, FREE_CLEARANCE) for body in bodies)

        free = not bodies or all(map(is_free_with, samples))
        self.world.set_joints(self.body, self.world.joints[self.body.index])
        return free

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
        """Return True if the inner sides of both fingers press on a body."""
        x, y, z = rotate(self.pose.orientation, (1.0, 0.0, 0.0))
        for finger in self.finger_links:
            if not self.world.contacts(self.body, body, finger):
                return False
            # Normals of contacts may be older than a rotation.
            points = self.world.closest_points(self.body, body, GRIP_DISTANCE, finger)
            normals = [point.normal for point in points]
            if not any(abs(n[0] * x + n[1] * y + n[2] * z) > GRIP_ALIGNMENT for n in normals):
                return False
        return True

    def _penetrated(self, mover: Body) -> list[Body]:
        """Return the bodies that a body penetrated in the last simulation step."""
        found = {c.other.index for c in self.world.contacts(mover) if c.distance < -REMAINING_DEPTH}
        return [self.world.bodies[index] for index in sorted(found)]

    def _shift(self) -> Vector | None:
        """Return the shift (m) of the robot and the grasped object out of the deepest other body, or None."""
        points = [
            point
            for mover in self._movers
            for other in self._penetrated(mover)
            if other not in self._movers
            for point in self.world.closest_points(mover, other)
        ]
        deepest = _deepest(points)
        return None if deepest is None else scaled(deepest.normal, -deepest.distance - REMAINING_DEPTH)

    def _push_out(self) -> bool:
        """Move the grasped object out of a finger; return True if it is too deep in neither finger."""
        held = self.held
        for _ in range(MAX_SHIFTS):
            if held is None or (shift := self._held_shift(held)) is None:
                return True
            self.world.carry(held, Pose(shift).compose(self.world.poses[held.index]))
        return False

    def _held_shift(self, held: Body) -> Vector | None:
        """Return the shift (m) of the grasped object out of the finger that it is too deep in, or None."""
        deepest = _deepest(self.world.closest_points(self.body, held))
        pressed = any(c.distance < -MAX_DEPTH for c in self.world.contacts(self.body, held))
        if deepest is None or not (pressed or -deepest.distance > MAX_HELD_DEPTH):
            return None
        # At most half of the depth, because the other finger is opposite.
        return scaled(deepest.normal, max(MAX_DEPTH + deepest.distance, deepest.distance / 2.0))

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
