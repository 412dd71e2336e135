"""Motions, grasps and state of a robot."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bulletarm_gym.config import MAX_TRANSLATION
from bulletarm_gym.config_checks import check_argument, fraction, numbers, rule
from bulletarm_gym.geometry import Pose, Vector, interpolate
from bulletarm_gym.robots.arm import CLEAR_ABOVE, FREE_CLEARANCE, MAX_SHIFTS, CollidingArm, path_length
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.simulation import World, motion
from bulletarm_gym.simulation.state import STILL

REFERENCE_DISTANCE = MAX_TRANSLATION
"""Length (m) of the motions whose durations :data:`FREE_STEPS` and :data:`CONTACT_STEPS` are."""
MIN_STEPS = 6
"""Minimum number of simulation steps of a motion."""
TRANSFER_HEIGHT = 0.4
"""Height (m) of simulated motions across a workspace."""
FREE_STEPS = 16
"""Number of simulation steps of a motion over the reference distance in free space."""
CONTACT_STEPS = 48
"""The number for motions in contact: friction keeps pushed blocks at a gripper that brakes by 3 m/s^2."""
LEVEL_TILT = 0.03
"""Maximum tilt (rad) of a gripper that points down. Grasped objects are never exactly level."""
LINE_STOPS = 4
"""Number of intermediate poses of a motion with a tilted gripper."""
SAMPLE_DISTANCE = 0.008
"""Distance (m) between the poses in the collision test of a path."""
OPENING_SAMPLES = 4
"""Number of intervals in the collision test of the fingers' path."""
OPENING_TOLERANCE = 5e-4
"""Difference of openings (m) below which the fingers do not move, and below which they hold nothing."""
MIN_SLIDE = 2e-3
"""Length (m) below which a blocked arm does not slide."""
SLIDE_GAP = 1e-3
"""Distance (m) by which a sliding arm moves away from what blocked it, so that it presses less."""
MAX_PUSHED_RATIO = 0.2
"""Fraction of the stroke by which fingers pushed closed by a contact stay closed until the next command."""


def transfer_stops(start: Pose, end: Pose) -> Iterator[Pose]:
    """Yield the poses of a path up, across and down, in steps of at most :data:`REFERENCE_DISTANCE`."""
    level = max(start.z, end.z, TRANSFER_HEIGHT)
    over = [Pose.planar(pose.x, pose.y, level, pose.yaw) for pose in (start, end)]
    for before, after in itertools.pairwise([start, *over, end]):
        count = max(1, math.ceil(path_length(before, after) / REFERENCE_DISTANCE))
        yield from (interpolate(before, after, number / count) for number in range(1, count + 1))


@dataclass(frozen=True)
class RobotState:
    """State of a robot apart from its joints.

    :param held: index of the grasped body, or None
    :param opening: commanded distance (m) between the fingers
    """

    held: int | None
    opening: float


class Robot(CollidingArm):
    """An arm with its gripper that moves and grasps.

    :param fast: move without simulation where the robot touches nothing
    """

    def __init__(self, model: RobotModel, world: World, fast: bool = True) -> None:
        super().__init__(model, world)
        self.fast = fast
        self._command = model.gripper.stroke

    def get_state(self) -> RobotState:
        """Return the state that is not part of the world's state."""
        return RobotState(None if self.held is None else self.held.index, self._command)

    def set_state(self, state: RobotState) -> None:
        """Set the state that is not part of the world's state."""
        self.held = None if state.held is None else self.world.bodies[state.held]
        self._command = state.opening

    def home(self, pose: Pose) -> None:
        """Set the empty, open gripper to a pose without a motion. The grasped object falls."""
        self._release()
        self.held = None
        self._command = self.model.gripper.stroke
        self._place(self._arm, self._solve(pose))
        self._place(self._fingers, [self.model.gripper.stroke / 2.0] * 2)

    def begin(self) -> None:
        """Start a motion: restore the snapshot of the world, without old contacts, and set the motors."""
        self.world.begin()
        self._send_targets()

    def _send_targets(self) -> None:
        motion.hold(self.world, self._arm, self.joint_positions)
        motion.send_fingers(self.world, self._fingers, self._command / 2.0, self.model.gripper.speed)

    def move_to(self, pose: Pose, in_contact: bool = True, slides: bool = False) -> None:
        """Move to a tool pose. A blocked arm stops.

        :param in_contact: move slowly where the robot may push an object
        :param slides: whether a blocked arm makes the part of the motion that leads along the contact
        :raises OutOfReachError: the pose is out of reach
        """
        normal = self._move_to(pose, in_contact)
        if slides and normal is not None and (beside := self._beside(pose, normal)) is not None:
            self.begin()
            self._move_to(beside, in_contact)

    def _move_to(self, pose: Pose, in_contact: bool) -> Vector | None:
        """Move to a tool pose; return the unit vector out of the body that blocks the arm, or None."""
        start, goal = self.pose, self.inverse_kinematics(pose)
        length = path_length(start, pose)
        if length < POSITION_TOLERANCE:
            return None
        stops = [*self._line(start, pose), goal]
        is_clear = self._is_clear(start, pose, stops, length)
        if is_clear and self.fast:
            self._release()
            self._place(self._arm, goal)
            return None
        return self._follow(stops, length, in_contact and not is_clear)

    def _beside(self, pose: Pose, normal: Vector) -> Pose | None:
        """Return the pose in reach to which a blocked arm slides, as a real one does, or None if too near."""
        position = np.array(self.pose.position)
        rest = np.array(pose.position) - position
        along = rest - (rest @ normal) * np.array(normal)
        along = along.clip(np.minimum(rest, 0.0), np.maximum(rest, 0.0))  # not where no motion was commanded
        if np.linalg.norm(along) < MIN_SLIDE:
            return None
        x, y, z = (position + along + SLIDE_GAP * np.array(normal)).tolist()
        beside = Pose((x, y, z), pose.orientation)
        return beside if self.reaches(beside) else None

    def move_joints(self, positions: Sequence[float]) -> None:
        """Move the arm joints by simulation, as slowly as in contact. A blocked arm stops.

        :param positions: joint positions (rad) in the order of ``model.joints``
        :raises ValueError: the number of positions is wrong, or one is outside its limits
        """
        limits = self.model.chain.limits
        check = rule(
            f"{len(limits)} joint positions (rad) within {limits.tolist()}",
            lambda goal: bool(((limits[:, 0] <= goal) & (goal <= limits[:, 1])).all()),
            numbers(count=len(limits)),
        )
        goal = check_argument("positions", positions, check)
        length = path_length(self.pose, self.model.chain.forward(np.array(goal)))
        self._follow([goal], length, in_contact=True)

    def _follow(self, stops: Sequence[Sequence[float]], length: float, in_contact: bool) -> Vector | None:
        steps, rise = self.duration(stops, length, in_contact and self.held is None)
        normal = motion.follow(self.world, self._arm, stops, steps, self.held, rise)
        self._finish()
        return normal

    def duration(
        self, stops: Sequence[Sequence[float]], length: float, in_contact: bool
    ) -> tuple[int, float]:
        """Return the number of simulation steps of a motion, and the fraction with positive acceleration.

        Motions of all lengths have equal accelerations, unless the joint torques need more time.

        :param stops: joint positions (rad) along the motion
        :param length: length (m) of the tool's path
        """
        pace, rise = (CONTACT_STEPS, motion.CONTACT_RISE) if in_contact else (FREE_STEPS, motion.RISE)
        path = np.array([self.joint_positions, *stops])
        least = self.dynamics.least_steps(path, np.array(self._arm.forces), self._load, rise)
        steps = max(MIN_STEPS, math.ceil(pace * math.sqrt(length / REFERENCE_DISTANCE)))
        return max(round(steps * self.world.physics.pace), least), rise

    def _line(self, start: Pose, end: Pose) -> list[tuple[float, ...]]:
        """Return intermediate joint positions (rad) that keep the tool on the line between two poses."""
        if end.tilt < LEVEL_TILT and self._is_straight(end, self.inverse_kinematics(end)):
            return []  # the joint motion deviates by some millimetres, otherwise by centimetres
        shares = np.linspace(0.0, 1.0, LINE_STOPS + 2)[1:-1].tolist()
        poses = [interpolate(start, end, share) for share in shares]
        return [self.inverse_kinematics(pose) for pose in poses if self.reaches(pose)]

    def transfer(self, *poses: Pose) -> None:
        """Move above all objects to the first of some poses without contact, else to the last pose.

        If both ends are free, the motion is not simulated: a free gripper can move straight up and down.

        :raises OutOfReachError: a pose is out of reach
        """
        if self.fast and self.is_apart() and any(map(self._jump, map(self.inverse_kinematics, poses))):
            self.begin()
            return
        for stop in filter(self.reaches, transfer_stops(self.pose, poses[-1])):
            self.move_to(stop)
            self.begin()

    def set_opening(self, ratio: float) -> None:
        """Move the fingers to a fraction of the stroke, 0 closed to 1 open. An object between stops them.

        :raises ValueError: ``ratio`` is not a number from 0 to 1
        """
        ratio = check_argument("ratio", ratio, fraction)
        command = ratio * self.model.gripper.stroke
        pushed = ratio - self.opening_ratio > MAX_PUSHED_RATIO
        if abs(command - self._command) < OPENING_TOLERANCE and not pushed:
            return
        self._command = command
        if self.fast and self._can_jump(command):
            self._place(self._fingers, [command / 2.0] * 2)
            return
        motion.drive_fingers(self.world, self._fingers, command / 2.0, self.model.gripper.speed)
        self._finish()

    def _release(self) -> None:
        """Record that the bodies that the robot holds or touches lose their support."""
        self.world.unsettled.update(body.index for body in self.touched(self.world.loose_bodies))

    def _place(self, group: motion.JointGroup, positions: Sequence[float]) -> None:
        self.world.set_joints(self.body, group.moved(self.world, positions))
        self._send_targets()

    def _finish(self) -> None:
        """Read the world and the grasped object, and stop both: the robot does not move between motions."""
        world = self.world
        world.end()
        world.set_joints(self.body, world.joints[self.body.index])
        # An object between the fingers keeps the opening above the command.
        is_squeezing = self.opening - self._command > OPENING_TOLERANCE
        bodies = [body for body in world.loose_bodies if is_squeezing and body.spec.mass > 0.0]
        before, self.held = self.held, next(filter(self._grips, bodies), None)
        if before is not None and before is not self.held:
            world.unsettled.add(before.index)
        if self.held is not None:
            world.twists[self.held.index] = STILL
            world.joint_rates[self.held.index] = (0.0,) * len(self.held.joints)
        self._shift_out()

    def resolve_penetration(self) -> None:
        """Move the robot out of other bodies, and the grasped object out of the fingers.

        If an object is too deep in both fingers, they open.
        """
        travel = self.model.gripper.stroke / 2.0
        for _ in range(2):
            if self._shift_out() and self._push_out():
                return
            wider = self._missing_opening() / 2.0
            fingers = self._fingers.positions(self.world)
            self._place(self._fingers, [min(joint + wider, travel) for joint in fingers])

    def _shift_out(self) -> bool:
        """Move robot and grasped object out of other bodies; return True if that succeeds."""
        for _ in range(MAX_SHIFTS):
            shift = self._shift()
            goal = None if shift is None else Pose(shift).compose(self.pose)
            if goal is None or not self.reaches(goal):
                return shift is None
            if self.held is None:  # fingers that press on a block would drag it
                self._command = self.opening
            self._carry(self.inverse_kinematics(goal))
        return False

    def _carry(self, goal: Sequence[float]) -> None:
        """Set the joint positions, and move the grasped object with the tool."""
        tool = self.pose
        self._place(self._arm, goal)
        if self.held is not None:
            before = self.world.poses[self.held.index]
            self.world.carry(self.held, self.pose.compose(tool.inverse().compose(before)))

    def _is_clear(self, start: Pose, end: Pose, stops: Sequence[Sequence[float]], length: float) -> bool:
        """Return True if nothing moves and the empty gripper touches nothing along a motion."""
        if not self._can_skip_simulation:
            return False
        lowest = min(self.model.gripper.lowest(start), self.model.gripper.lowest(end))
        if lowest < FREE_CLEARANCE:
            return False
        count = math.ceil(length / SAMPLE_DISTANCE)
        samples = motion.interpolate_path(
            [self.joint_positions, *stops], np.arange(1, count + 1) / count
        ).tolist()
        return self._is_free(self._arm, samples, self._bodies_above(lowest - CLEAR_ABOVE))

    def _jump(self, goal: Sequence[float]) -> bool:
        """Set the joint positions, unless robot or grasped object then touch something else."""
        joints, held = self.joint_positions, self.held
        before = None if held is None else self.world.poses[held.index]
        self._carry(goal)
        if self.is_apart():
            return True
        self._place(self._arm, joints)
        if held is not None and before is not None:
            self.world.carry(held, before)
        return False

    def _can_jump(self, command: float) -> bool:
        """Return True if the fingers touch nothing on the path to a new opening."""
        if not self._can_skip_simulation:
            return False
        near = self._bodies_above(self.model.gripper.lowest(self.pose) - CLEAR_ABOVE)
        openings = np.linspace(self.opening, command, OPENING_SAMPLES + 1).tolist()
        return self._is_free(self._fingers, ([opening / 2.0] * 2 for opening in openings), near)
