"""The joints of a robot in a world: measurements and inverse kinematics."""

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from bulletarm_gym.geometry import Pose, conjugate, interpolate, multiply
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.robots.model import Dynamics, RobotModel
from bulletarm_gym.simulation import Body, BodySpec, Contact, World
from bulletarm_gym.simulation.motion import JointGroup, add_gear_constraint

REFERENCE_DISTANCE = 0.05
"""Length (m) of a closed-loop step (paper, Close-Loop 4D Benchmark)."""
MIN_STEPS = 6
"""Minimum number of simulation steps of a motion."""
YAW_RADIUS = 0.06
"""Distance (m) per rad of rotation about the tool's z axis: half an open gripper and its fingers."""
TILT_RADIUS = 0.25
"""Distance (m) per rad of tilt: from the fingertips to the wrist of an arm."""
MAX_SAG = 0.2
"""Maximum distance of a motion from the straight line relative to its length."""
TRANSFER_HEIGHT = 0.4
"""Height (m) of simulated motions across a workspace."""


def path_length(start: Pose, end: Pose) -> float:
    """Return the maximum distance (m) that fingertips, open fingers or wrist move between tool poses."""
    x, y, z, w = multiply(conjugate(start.orientation), end.orientation)
    yaw = 2.0 * math.atan2(abs(z), abs(w))
    tilt = 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w))
    return max(math.dist(start.position, end.position), YAW_RADIUS * yaw, TILT_RADIUS * tilt)


def is_straight(start: Pose, middle: Pose, end: Pose) -> bool:
    """Return True if the middle of a motion is near the straight line between its ends."""
    off = math.dist(middle.position, interpolate(start, end, 0.5).position)
    return off < MAX_SAG * path_length(start, end)


def transfer_stops(start: Pose, end: Pose) -> Iterator[Pose]:
    """Yield the poses of a path up, across and down, in steps of at most :data:`REFERENCE_DISTANCE`."""
    level = max(start.z, end.z, TRANSFER_HEIGHT)
    over = [Pose.planar(pose.x, pose.y, level, pose.yaw) for pose in (start, end)]
    for before, after in itertools.pairwise([start, *over, end]):
        count = max(1, math.ceil(path_length(before, after) / REFERENCE_DISTANCE))
        yield from (interpolate(before, after, number / count) for number in range(1, count + 1))


def motion_steps(length: float, reference_steps: int) -> int:
    """Return the number of simulation steps of a motion with the acceleration of a reference motion.

    :param length: length (m) of the motion
    :param reference_steps: number of steps of a motion over :data:`REFERENCE_DISTANCE`
    """
    return max(MIN_STEPS, math.ceil(reference_steps * math.sqrt(length / REFERENCE_DISTANCE)))


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
        add_gear_constraint(world, self._fingers, model.gripper.friction)
        self.dynamics = Dynamics(self.body, self._arm.joints, model.chain)
        self.held: Body | None = None
        self._inverse = lru_cache(maxsize=CACHE_SIZE)(model.inverse)
        self._forward = lru_cache(maxsize=1)(lambda joints: model.chain.forward(np.array(joints)))
        limits = model.chain.solution_limits.tolist()
        self._wrist_limits: list[float] = limits[-1]
        self._turning_joints = [
            (j, low, high) for j, (low, high) in enumerate(limits) if high - low >= math.tau
        ]

    # Measurements

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
        return tuple(rates[slot] for slot in self._arm.slots)

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
    def contacts(self) -> list[Contact]:
        """Contacts of the robot in the last simulation step; empty after a motion without simulation."""
        return self.world.contacts(self.body)

    @property
    def finger_links(self) -> list[int]:
        """Indices of the finger links in Bullet."""
        return self._fingers.joints

    @property
    def opening(self) -> float:
        """Distance (m) between the fingers."""
        return sum(self._fingers.positions(self.world))

    @property
    def opening_ratio(self) -> float:
        """Opening relative to the gripper's stroke, 0 closed to 1 open."""
        return min(1.0, max(0.0, self.opening / self.model.gripper.stroke))

    @property
    def _load(self) -> float:
        """Mass (kg) of the grasped object."""
        return 0.0 if self.held is None else self.world.get_properties(self.held).mass

    def show_joints(self, positions: Sequence[float]) -> None:
        """Set the arm joints (rad) for a query of the world, until the next motion begins."""
        self.world.show_joints(self.body, self._arm.moved(self.world, positions))

    # Inverse kinematics

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
        if error > POSITION_TOLERANCE:
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
        if max(_changes(self.joint_positions, goal)) >= MAX_JOINT_CHANGE:
            return False
        return self._is_straight(pose, goal) or self.wrist_room(pose) > self.wrist_room()

    def _is_straight(self, pose: Pose, goal: Sequence[float]) -> bool:
        now = self.joint_positions
        if max(_changes(now[:-1], goal[:-1])) < STRAIGHT_JOINT_CHANGE:
            return True
        return is_straight(self.pose, self.model.chain.forward((np.array(now) + goal) / 2.0), pose)

    def wrist_room(self, pose: Pose | None = None) -> float:
        """Return the distance (rad) of the last joint from its nearer limit, now or at a pose in reach."""
        joints = self.joint_positions if pose is None else self.inverse_kinematics(pose)
        low, high = self._wrist_limits
        return min(joints[-1] - low, high - joints[-1])


def _changes(start: Sequence[float], end: Sequence[float]) -> list[float]:
    return [abs(after - before) for before, after in zip(start, end, strict=True)]
