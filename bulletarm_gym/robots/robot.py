"""An arm at work in a world: the whole interface that tasks, controls and planners rely on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from bulletarm_gym.geometry import Pose, interpolate
from bulletarm_gym.robots.clearance import CLEAR_ABOVE, FREE_CLEARANCE, Clearance
from bulletarm_gym.robots.dynamics import Dynamics
from bulletarm_gym.robots.fingers import couple_fingers
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.overlap import YIELDS, push_out, squeeze, way_out
from bulletarm_gym.robots.way import REFERENCE_DISTANCE, distance, is_straight, stops_over
from bulletarm_gym.simulation import Body, BodySpec, World
from bulletarm_gym.simulation.motion import (
    CAREFUL_RISE,
    RISE,
    JointGroup,
    drive_fingers,
    follow,
    hold,
    motion_steps,
    on_the_way,
    send_fingers,
)

QUICK_STEPS = 16
"""Simulation steps of a move by the reference distance with something in the gripper, or away from it ..."""
CAREFUL_STEPS = 48
"""... and where something may be pushed: braking at 3 m/s^2 at most, friction keeps blocks at the gripper."""
LEAST_STEPS = 6
FULL_TURN = 2.0 * math.pi
MAX_TURN = math.pi
"""Change of a joint (rad) from which a move goes the long way round, because a joint limit is in between."""
CALM_TURN = 0.3
"""Change of the joints but the last (rad) below which a move by the reference distance is almost straight."""
LEVEL_TILT = 0.03
"""Tilt (rad) up to which the gripper counts as looking down: what is grasped is never quite even."""
LINE_STOPS = 4
"""Points between two poses that a tilted gripper is led through."""
SAMPLE_DISTANCE = 0.008
"""Spacing (m) of the poses a path is checked at; with the clearance, less than a finger slips between."""
OPENING_SAMPLES = 4
"""Number of intervals in which the path of the fingers is checked."""
OPENING_TOLERANCE = 5e-4
"""Difference of openings (m) too small to move the fingers for, or to be a squeeze."""
GIVING_WAY = 0.2
"""Share of the stroke by which fingers that were pushed shut are left so, as long as the command stays."""
REMEMBERED = 64
"""Number of poses whose solutions are cached."""


class OutOfReachError(ValueError):
    """The fingertips cannot be brought to a pose."""


@dataclass(frozen=True)
class RobotState:
    """What the arm remembers besides its joints.

    :param held: index of the body in the gripper, or None
    :param opening: commanded distance (m) between the fingers
    """

    held: int | None
    opening: float


class Robot:
    """An arm with its gripper.

    Its pose is that of the fingertips: z up when the gripper looks down, x along which the fingers open.

    :param model: which arm
    :param world: where it is loaded
    :param fast: move without simulation where nothing can be touched
    """

    def __init__(self, model: RobotModel, world: World, fast: bool = True) -> None:
        self.model = model
        self.fast = fast
        self._world = world
        self.body = world.add_urdf(BodySpec(model.name, (), 0.0), model.xml, model.base)
        names = [world.client.getJointInfo(self.body.id, joint)[1].decode() for joint in self.body.joints]
        self._arm = JointGroup(self.body, tuple(names.index(name) for name in model.joints), model.torques)
        fingers = tuple(names.index(name) for name in model.gripper.joints)
        self._fingers = JointGroup(self.body, fingers, (model.gripper.force,) * 2)
        couple_fingers(world, self.body, self._fingers.joints, model.gripper.friction)
        self._dynamics = Dynamics.of(world, self.body, self._arm.joints, model.chain)
        self._clearance = Clearance(world, self.body, model.gripper)
        self.held: Body | None = None
        self._command = model.gripper.stroke
        # An action asks for the same few poses again and again.
        self._inverse = lru_cache(maxsize=REMEMBERED)(model.inverse)
        self._wrist_limits: list[float] = model.chain.solution_limits[-1].tolist()
        self._posed: tuple[tuple[float, ...], Pose] = ((), Pose((0.0, 0.0, 0.0)))

    # State

    @property
    def pose(self) -> Pose:
        """Pose of the fingertips in the world."""
        joints = self._arm.positions(self._world)
        if joints != self._posed[0]:
            self._posed = (joints, self.model.chain.forward(np.array(joints)))
        return self._posed[1]

    @property
    def joint_positions(self) -> tuple[float, ...]:
        """Positions (rad) of the arm's joints, from the base on."""
        return self._arm.positions(self._world)

    @property
    def opening(self) -> float:
        """Distance (m) between the fingers."""
        return sum(self._fingers.positions(self._world))

    @property
    def opening_ratio(self) -> float:
        """Opening over the gripper's stroke, 0 closed to 1 open."""
        return min(1.0, max(0.0, self.opening / self.model.gripper.stroke))

    def get_state(self) -> RobotState:
        """Return what is not in the world's state."""
        return RobotState(None if self.held is None else self.held.index, self._command)

    def set_state(self, state: RobotState) -> None:
        """Return to a state; the joints are the world's."""
        self.held = None if state.held is None else self._world.bodies[state.held]
        self._command = state.opening

    def inverse_kinematics(self, pose: Pose) -> tuple[float, ...]:
        """Return joint positions (rad) inside the limits for a pose of the fingertips.

        Whole turns are added to each joint to bring it nearest to its present position.

        :raises OutOfReachError: no solution is inside the joint limits
        """
        # Whole turns are added, so that the digits depend on the pose alone.
        solution: list[float] = self._solve(pose)
        if self._turns:
            now = self._arm.positions(self._world)
            for joint, (low, high) in self._turns:
                turns = round((now[joint] - solution[joint]) / FULL_TURN)
                least = math.ceil((low - solution[joint]) / FULL_TURN)
                most = math.floor((high - solution[joint]) / FULL_TURN)
                solution[joint] += FULL_TURN * min(max(turns, least), most)
        return tuple(solution)

    @cached_property
    def _turns(self) -> list[tuple[int, tuple[float, float]]]:
        """Joints whose limits (rad) leave room for a whole turn."""
        limits = self.model.chain.solution_limits.tolist()
        return [(joint, (low, high)) for joint, (low, high) in enumerate(limits) if high - low >= FULL_TURN]

    def reaches(self, pose: Pose) -> bool:
        """Whether the fingertips can be brought to a pose."""
        return self._inverse(pose)[1] <= POSITION_TOLERANCE

    def can_move_to(self, pose: Pose) -> bool:
        """Return True if one motion leads to a pose: in reach, no joint limit in between, almost straight.

        A motion that leaves the limit of the last joint may swing.
        """
        if not self.reaches(pose):
            return False
        now, goal = self._arm.positions(self._world), self.inverse_kinematics(pose)
        if max(abs(after - before) for before, after in zip(now, goal, strict=True)) >= MAX_TURN:
            return False
        return self._is_straight(pose, goal) or self.wrist_room(pose) > self.wrist_room()

    def _is_straight(self, pose: Pose, goal: Sequence[float]) -> bool:
        """Return True if a joint motion to a pose keeps near the line to it."""
        now = self._arm.positions(self._world)
        turns = (abs(after - before) for before, after in zip(now[:-1], goal[:-1], strict=True))
        if max(turns) < CALM_TURN:
            return True
        return is_straight(self.pose, self.model.chain.forward((np.array(now) + goal) / 2.0), pose)

    def wrist_room(self, pose: Pose | None = None) -> float:
        """Return the distance (rad) of the last joint from its nearer limit, now or at a pose in reach."""
        joints = self._arm.positions(self._world) if pose is None else self.inverse_kinematics(pose)
        low, high = self._wrist_limits
        return min(joints[-1] - low, high - joints[-1])

    def is_free_at(self, pose: Pose, bodies: Sequence[Body]) -> bool:
        """Whether the arm would touch none of some bodies with its fingertips at a pose in reach."""
        return self._clearance.is_free([self._arm.moved(self._world, self._solve(pose))], bodies)

    def _solve(self, pose: Pose) -> list[float]:
        joints, error = self._inverse(pose)
        if error > POSITION_TOLERANCE:
            raise OutOfReachError(f"robot {self.model.name!r} cannot reach {pose}: {error:.4f} remain")
        solution: list[float] = joints.tolist()
        return solution

    # Motion

    def home(self, pose: Pose) -> None:
        """Put the empty, open gripper at a pose at once; what it held or touched falls."""
        self._leave()
        self.held = None
        self._command = self.model.gripper.stroke
        self._place(self._arm, self._solve(pose))
        self._place(self._fingers, [self.model.gripper.travel] * 2)

    def begin(self) -> None:
        """Start a move from the canonical world.

        Contacts are forgotten, which keep their normals through a turn: a finger would drag what it lets go.
        Motor targets, which no snapshot holds, are sent again.
        """
        self._world.begin()
        self._send_targets()

    def _send_targets(self) -> None:
        hold(self._world, self._arm, self._arm.positions(self._world))
        send_fingers(self._world, self._fingers, self._command / 2.0, self.model.gripper.speed)

    def move_to(self, pose: Pose, careful: bool = True) -> None:
        """Bring the fingertips to a pose; a blocked arm stops on the way.

        :param careful: go slowly where something may be pushed; not needed on the way back from it
        :raises OutOfReachError: the fingertips cannot be brought there
        """
        start, goal = self.pose, self.inverse_kinematics(pose)
        length = distance(start, pose)
        if length < POSITION_TOLERANCE:
            return
        stops = [*self._line(start, pose), goal]
        clear = self._is_clear(start, pose, stops, length)
        if clear and self.fast:
            self._leave()
            self._place(self._arm, goal)
            return
        slow = careful and not clear and self.held is None
        steps, rise = self._duration(stops, length, slow)
        follow(self._world, self._arm, stops, steps, self.held, rise)
        self._finish()

    def _duration(self, stops: Sequence[Sequence[float]], length: float, slow: bool) -> tuple[int, float]:
        """Return the simulation steps of a motion through stops, and the share of them spent speeding up.

        It takes at least as long as the joint torques need.
        """
        pace, rise = (CAREFUL_STEPS, CAREFUL_RISE) if slow else (QUICK_STEPS, RISE)
        steps = motion_steps(length, REFERENCE_DISTANCE, pace, LEAST_STEPS)
        path = np.array([self._arm.positions(self._world), *stops])
        load = 0.0 if self.held is None else self._world.get_properties(self.held).mass
        least = self._dynamics.least_steps(path, np.array(self._arm.forces), load, rise)
        return max(round(steps * self._world.physics.pace), least), rise

    def _line(self, start: Pose, end: Pose) -> list[tuple[float, ...]]:
        """Return joint positions (rad) between two poses that keep the gripper on the line.

        While it looks down most joint motions sag some millimetres; tilted, they swing by centimetres.
        """
        if end.tilt < LEVEL_TILT and self._is_straight(end, self.inverse_kinematics(end)):
            return []
        shares = np.linspace(0.0, 1.0, LINE_STOPS + 2)[1:-1].tolist()
        poses = [interpolate(start, end, share) for share in shares]
        return [self.inverse_kinematics(pose) for pose in poses if self.reaches(pose)]

    def transfer(self, *poses: Pose) -> None:
        """Move to the first of some poses where the robot touches nothing, or to the last, over everything.

        A gripper that touches nothing can go straight up, and one that will touch nothing can come straight
        down. Only the two ends decide whether the path is simulated. It leads through poses in reach.

        :raises OutOfReachError: a pose is out of reach
        """
        if self.fast and self.is_apart() and any(map(self._jump, map(self.inverse_kinematics, poses))):
            self.begin()
            return
        for stop in filter(self.reaches, stops_over(self.pose, poses[-1])):
            self.move_to(stop)
            self.begin()

    def set_opening(self, ratio: float) -> None:
        """Bring the gripper to a ratio of its stroke, 0 closed to 1 open; an object in between stops it."""
        command = ratio * self.model.gripper.stroke
        # What the fingers ran into may have pushed them shut since: a little is given way to, no more.
        pushed = ratio - self.opening_ratio > GIVING_WAY
        if abs(command - self._command) < OPENING_TOLERANCE and not pushed:
            return
        self._command = command
        if self.fast and self._can_jump(command):
            self._place(self._fingers, [command / 2.0] * 2)
            return
        drive_fingers(self._world, self._fingers, command / 2.0, self.model.gripper.speed)
        self._finish()

    def touched(self, bodies: Sequence[Body]) -> list[Body]:
        """Return those of some bodies that the arm holds or touches."""
        return self._clearance.touched(self.pose, self.held, bodies)

    def _leave(self) -> None:
        """Record that the bodies that the arm holds or touches lose their support."""
        self._world.unsettled.update(body.index for body in self.touched(self._world.loose_bodies))

    def _place(self, group: JointGroup, positions: Sequence[float]) -> None:
        self._world.set_joints(self.body, group.moved(self._world, positions))
        self._send_targets()

    def _finish(self) -> None:
        """Read the world and what the fingers hold; the arm, and what it holds, stand still between moves."""
        self._world.end()
        self._world.set_joints(self.body, self._world.joints[self.body.index])
        bodies = self._world.free_bodies if self._is_squeezing else []
        before, self.held = self.held, next((body for body in bodies if self._grips(body)), None)
        if before is not None and before is not self.held:
            self._world.unsettled.add(before.index)
        if self.held is not None:
            self._world.rest(self.held)
        self._draw_out()

    def resolve_penetration(self) -> None:
        """Take the resting arm out of what it is too deep in, and what it holds out of a finger.

        What is too deep in both fingers opens them.
        """
        travel = self.model.gripper.travel
        for _ in range(2):
            if self._draw_out() and push_out(self._world, self.held, self.body):
                return
            wider = squeeze(self._world, self.body, self._fingers.joints, self.held) / 2.0
            fingers = self._fingers.positions(self._world)
            self._place(self._fingers, [min(joint + wider, travel) for joint in fingers])

    def _draw_out(self) -> bool:
        """End overlaps of the resting arm and its load with other bodies; return True if that succeeds."""
        for _ in range(YIELDS):
            way = way_out(self._world, self.body, self.held)
            goal = None if way is None else Pose(way).compose(self.pose)
            if goal is None or not self.reaches(goal):
                return way is None
            if self.held is None:  # fingers pressed on a block would go on dragging it under themselves
                self._command = self.opening
            self._carry(self.inverse_kinematics(goal))
        return False

    def _carry(self, goal: Sequence[float]) -> None:
        """Put the arm at joint positions, what it holds with it."""
        hand = self.pose
        self._place(self._arm, goal)
        if self.held is not None:
            before = self._world.poses[self.held.index]
            self._world.carry(self.held, self.pose.compose(hand.inverse().compose(before)))

    @property
    def _is_squeezing(self) -> bool:
        """Whether something keeps the fingers from closing as far as they should: without it, no grip."""
        return self.opening - self._command > OPENING_TOLERANCE

    def _grips(self, body: Body) -> bool:
        return all(self._clearance.presses(joint, body, self.pose) for joint in self._fingers.joints)

    # Free space

    def _is_clear(self, start: Pose, end: Pose, stops: Sequence[Sequence[float]], length: float) -> bool:
        """Whether nothing moves and nothing can be touched on the way."""
        if self.held is not None or not self._clearance.can_be_tested:
            return False
        lowest = min(self.model.gripper.lowest(start), self.model.gripper.lowest(end))
        if lowest < FREE_CLEARANCE:
            return False
        count = math.ceil(length / SAMPLE_DISTANCE)
        shares = np.arange(1, count + 1) / count
        samples = on_the_way([self._arm.positions(self._world), *stops], shares).tolist()
        joints = (self._arm.moved(self._world, sample) for sample in samples)
        return self._clearance.is_free(joints, self._clearance.bodies_above(lowest - CLEAR_ABOVE))

    def _jump(self, goal: Sequence[float]) -> bool:
        """Put the arm, with what it holds, at joint positions, unless it touches something else there."""
        joints, held = self._arm.positions(self._world), self.held
        before = None if held is None else self._world.poses[held.index]
        self._carry(goal)
        if self.is_apart():
            return True
        self._place(self._arm, joints)
        if held is not None and before is not None:
            self._world.carry(held, before)
        return False

    def is_apart(self) -> bool:
        """Whether the arm and what it holds touch nothing else."""
        return self._clearance.is_apart(self.pose, self.held)

    def _can_jump(self, command: float) -> bool:
        """Whether the fingers touch nothing, and will not on the way to a new opening.

        What they touch may hang between them, two objects in a row say, though they hold neither.
        """
        if self.held is not None or not self._clearance.can_be_tested:
            return False
        near = self._clearance.bodies_above(self.model.gripper.lowest(self.pose) - CLEAR_ABOVE)
        start, way = self.opening / 2.0, (command - self.opening) / 2.0
        openings = [start + way * number / OPENING_SAMPLES for number in range(OPENING_SAMPLES + 1)]
        joints = (self._fingers.moved(self._world, [half, half]) for half in openings)
        return self._clearance.is_free(joints, near)
