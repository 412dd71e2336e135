"""Close-loop control: each action moves the gripper a little (paper, Close-loop Environments)."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig
from bulletarm_gym.control.control import POINTS, Control, Outcome, over
from bulletarm_gym.experts.approach import avoid_limits, route
from bulletarm_gym.experts.waypoints import OPEN, Waypoint
from bulletarm_gym.geometry import Pose, Rectangle, Vector, wrap_angle
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors import Frame, View
from bulletarm_gym.tasks import Task

MAX_TRANSLATION = 0.05
"""Farthest move (m) along an axis (paper, Close-Loop 4D Benchmark)."""
MAX_ROTATION = math.pi / 4.0
"""Farthest turn (rad) about z (paper, Close-Loop 4D Benchmark)."""
VIEW_SCALE = 1.5
"""Side of the observed square in workspaces: 0.45 m for 0.3 m (paper, Benchmark Details)."""
CAMERA_OFFSET = 0.1
"""Height (m) of the virtual camera plane above the fingertips."""
START_HEIGHT = 0.2
"""Height (m) of the fingertips over the workspace's centre at reset."""
FINGER_SQUARE = 0.021
"""Side (m) of the squares that stand for the fingers: 6 of 128 pixels over 0.45 m."""
YAW_OFFSETS = tuple(sign * step * MAX_ROTATION / 16.0 for step in range(33) for sign in (1.0, -1.0))
"""Offsets (rad) from the commanded yaw, nearest first, that are tried to stay inside the joint limits."""
ARRIVED = 0.999
"""Share of the way to a waypoint that counts as all of it."""


@dataclass(frozen=True)
class DeltaMove:
    """A close-loop action in physical units.

    :param opening: gripper opening ratio, 0 closed to 1 open
    :param translation: of the fingertips (m), along the world's axes
    :param rotation: of the gripper about z (rad)
    """

    opening: float
    translation: Vector
    rotation: float = 0.0


class CloseLoop(Control[DeltaMove]):
    """Delta-pose control.

    An action is one number in [-1, 1] a character of ``action_sequence``: p the opening (-1 closed, +1 open),
    x, y and z the translation, r the rotation; without r the gripper does not turn.

    :param config: the environment's parameters
    :param scene: what is acted on
    :param task: what is to be done
    """

    kind = CLOSE_LOOP

    def __init__(self, config: EnvConfig, scene: Scene, task: Task) -> None:
        height = min(max(START_HEIGHT, config.workspace[2][0]), config.workspace[2][1])
        extremes = (Pose.planar(*position) for position in over(config, config.workspace[2], POINTS))
        super().__init__(config, scene, Pose.planar(*config.centre, height), extremes)
        self._finds_way = task.plans_moves
        self._opening = min(task.hints.opening / scene.robot.model.gripper.stroke, OPEN)
        self._workspace = config.workspace
        self._extent = VIEW_SCALE * config.workspace_size
        farthest = {**dict.fromkeys("xyz", MAX_TRANSLATION), "r": MAX_ROTATION}
        self.ranges = {name: (-most, most) for name, most in farthest.items() if name in self.sequence}

    def decode_action(self, action: ArrayLike, view: View) -> DeltaMove:
        """Return what an action means; numbers outside [-1, 1] are clipped.

        :raises ValueError: the action has the wrong shape or is not finite
        """
        value = dict(zip(self.sequence, self.numbers(action), strict=True))
        x, y, z = (MAX_TRANSLATION * value[axis] for axis in "xyz")
        return DeltaMove((value["p"] + 1.0) / 2.0, (x, y, z), MAX_ROTATION * value.get("r", 0.0))

    def encode_action(self, move: DeltaMove) -> NDArray[np.float32]:
        """Return the action for a move, the inverse of :meth:`decode_action`; what is too far is clipped."""
        value = dict(zip("xyz", (part / MAX_TRANSLATION for part in move.translation), strict=True))
        value |= {"p": 2.0 * move.opening - 1.0, "r": move.rotation / MAX_ROTATION}
        return np.array([value[axis] for axis in self.sequence], dtype=np.float32).clip(-1.0, 1.0)

    def apply(self, scene: Scene, move: DeltaMove) -> Outcome:
        """Carry out a move: the arm first, then the gripper.

        At a joint limit the gripper takes the nearest yaw inside the limits. A move whose position is out of
        reach is ignored.
        """
        hand = scene.robot.pose
        x, y, z = self.within(map(sum, zip(hand.position, move.translation, strict=True)))
        poses = (Pose.planar(x, y, z, hand.yaw + move.rotation + offset) for offset in YAW_OFFSETS)
        pose = next(filter(scene.robot.follows, poses), None)
        return Outcome(ignored=True) if pose is None else self.go(scene, pose, move.opening)

    def within(self, position: Iterable[float]) -> Vector:
        """Return the point (m) of the workspace that is nearest to a position."""
        limits = zip(position, self._workspace, strict=True)
        x, y, z = (min(max(value, low), high) for value, (low, high) in limits)
        return (x, y, z)

    def go(self, scene: Scene, pose: Pose, opening: float) -> Outcome:
        """Bring the fingertips to a pose, then the gripper to an opening ratio.

        It is ignored, and nothing is done, if the pose is out of reach.
        """
        if not scene.robot.follows(pose):
            return Outcome(ignored=True)
        scene.robot.move_to(pose)
        scene.robot.set_opening(opening)
        return Outcome(ignored=False)

    def next_move(self, scene: Scene, plan: Iterator[Waypoint]) -> DeltaMove:
        """Return the move towards the first waypoint of a plan, or on the way to its pick or place."""
        first = next(plan)
        if self._finds_way and first.finish is not None and not first.clear:
            first = next(route(scene, first, self._opening))
        return self.towards(scene, first)

    def towards(self, scene: Scene, waypoint: Waypoint) -> DeltaMove:
        """Return the move that brings the gripper closest to a waypoint."""
        hand, goal = scene.robot.pose, avoid_limits(scene, waypoint.pose)
        target = self.within(goal.position)
        way = [end - now for end, now in zip(target, hand.position, strict=True)]
        turn = self._turn(scene, hand, goal.yaw)
        excess = max(*(abs(part) / MAX_TRANSLATION for part in way), abs(turn) / MAX_ROTATION)
        scale = 1.0 / excess if waypoint.straight and excess > 1.0 else 1.0
        x, y, z = (min(max(part * scale, -MAX_TRANSLATION), MAX_TRANSLATION) for part in way)
        arrives = excess * ARRIVED <= 1.0 or (
            "r" not in self.sequence and max(map(abs, way)) <= MAX_TRANSLATION
        )
        opening = waypoint.finish if arrives and waypoint.finish is not None else waypoint.gripper
        return DeltaMove(opening, (x, y, z), min(max(turn, -MAX_ROTATION), MAX_ROTATION))

    def _turn(self, scene: Scene, hand: Pose, yaw: float) -> float:
        """Return the rotation (rad) to a yaw, the long way round where a joint limit blocks the short one."""
        turn = wrap_angle(yaw - hand.yaw)
        step = min(max(turn, -MAX_ROTATION), MAX_ROTATION)
        if step == turn or scene.robot.follows(Pose.planar(*hand.position, hand.yaw + step)):
            return turn
        return turn - math.copysign(2.0 * math.pi, turn)

    def frame(self, scene: Scene) -> Frame:
        """Return the square about the fingertips, seen from a plane over them, the gripper as two squares.

        It keeps the world's axes.
        """
        return hand_frame(scene.robot.pose, scene.robot.opening, self._extent)


def hand_frame(hand: Pose, opening: float, extent: float) -> Frame:
    """Return a square of a side ``extent`` (m) about the fingertips, which are ``opening`` (m) apart."""
    return Frame(hand, extent, hand.z + CAMERA_OFFSET, gripper_squares(hand, opening))


def gripper_squares(hand: Pose, opening: float) -> tuple[Rectangle, Rectangle]:
    """Return the squares that stand for the fingers, inner sides ``opening`` (m) apart, turned."""
    offset = (opening + FINGER_SQUARE) / 2.0
    x, y = offset * math.cos(hand.yaw), offset * math.sin(hand.yaw)
    first, second = (
        Rectangle(hand.x + sign * x, hand.y + sign * y, FINGER_SQUARE, FINGER_SQUARE, hand.yaw)
        for sign in (1.0, -1.0)
    )
    return first, second
