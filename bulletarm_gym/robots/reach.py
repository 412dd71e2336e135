"""Study of the poses that an arm reaches inside its joint limits."""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose, conjugate, multiply, yaw_quaternion
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.robots.model import RobotModel

Limits = Sequence[Sequence[float]]
"""[low, high] (m) along x, y and, in a workspace, z."""

TILT = math.radians(30.0)
"""Largest tilt (rad) of the paper's 6D tasks."""
YAWS = (-math.pi / 2.0, 0.0, math.pi / 2.0)
"""Rotations (rad) of the gripper about the vertical."""
DIRECTIONS = tuple(np.linspace(-math.pi, math.pi, 8, endpoint=False).tolist())
"""Directions (rad) of the tilt."""
FLOOR = 0.01
"""Lower limit (m) of the fingertips' height in the largest workspace."""
TOPS = (0.25, 0.18, 0.12, 0.08)
"""Candidates (m) for the upper limit; the first with a side of :data:`MIN_SIDE` is used."""
MIN_SIDE = 0.1
"""Minimum side length (m) of the largest workspace."""
CELL = 0.02
"""Grid spacing (m) in the search of the largest workspace."""


@dataclass(frozen=True)
class ReachStudy:
    """Results of inverse kinematics for some poses.

    :param count: number of poses
    :param solved: poses in reach with their joint positions (n,) rad
    :param limited: number of poses beyond a joint limit, by the name of the joint
    """

    count: int
    solved: list[tuple[Pose, FloatArray]]
    limited: Counter[str]

    @property
    def share(self) -> float:
        """Fraction of the poses in reach."""
        return len(self.solved) / self.count


def study_reach(model: RobotModel, poses: Iterable[Pose]) -> ReachStudy:
    """Return the results of inverse kinematics for some poses."""
    count, solved, limited = 0, [], Counter[str]()
    for pose in poses:
        count += 1
        joints, error = model.inverse(pose)
        if error <= POSITION_TOLERANCE:
            solved.append((pose, joints))
        elif max(pose_error(model.chain.forward(joints), pose)) <= POSITION_TOLERANCE:
            lower, upper = model.chain.solution_limits.T
            limited[model.joints[int(np.maximum(lower - joints, joints - upper).argmax())]] += 1
    return ReachStudy(count, solved, limited)


def pose_error(pose: Pose, goal: Pose) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses."""
    x, y, z, w = multiply(conjugate(pose.orientation), goal.orientation)
    return math.dist(pose.position, goal.position), 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def grid(limits: Limits, heights: Sequence[float], points: int, tilt: float = 0.0) -> Iterator[Pose]:
    """Yield a grid of tool poses at three yaws, upright or tilted (rad) in eight directions.

    :param points: number of positions along x and y
    """
    xs, ys = (np.linspace(low, high, points).tolist() for low, high in limits[:2])
    directions = (0.0,) if tilt == 0.0 else DIRECTIONS
    for x, y, z, yaw, direction in itertools.product(xs, ys, heights, YAWS, directions):
        sine = math.sin(tilt / 2.0)
        tilted = (sine * math.cos(direction), sine * math.sin(direction), 0.0, math.cos(tilt / 2.0))
        yield Pose((x, y, z), multiply(tilted, yaw_quaternion(yaw)))


def largest_workspace(model: RobotModel) -> Limits:
    """Return the limits (m) of the largest workspace in front of the base in reach of the upright gripper."""
    for top in TOPS:
        square = _largest_square(model, (FLOOR, (FLOOR + top) / 2.0, top))
        if square[0][1] - square[0][0] >= MIN_SIDE:
            break
    return [*square, [FLOOR, top]]


def _largest_square(model: RobotModel, heights: Sequence[float]) -> Limits:
    """Return the x and y limits (m) of the largest square, symmetric about the x axis of the base."""
    count = math.ceil(float(np.linalg.norm(model.chain.translations[1:], axis=1).sum()) / CELL)
    is_free = cache(lambda row, column: _reaches(model, CELL * (row + 1), CELL * column, heights))
    half, first = 0, 0  # half of the side and the nearest row, in cells
    for row in range(count):
        while all(is_free(row + r, c) for r in reversed(range(2 * half + 3)) for c in range(half + 2)):
            half, first = half + 1, row
    near, aside = model.base.x + CELL * (first + 1), CELL * half
    middle = model.base.y
    square = [[near, near + 2.0 * aside], [middle - aside, middle + aside]]
    return [[round(low, 3), round(high, 3)] for low, high in square]


def _reaches(model: RobotModel, depth: float, aside: float, heights: Sequence[float]) -> bool:
    """Return True if the upright gripper reaches two positions (m) symmetric about the x axis of the base."""
    x, y = model.base.x + depth, model.base.y
    poses = (
        Pose.planar(x, y + side * aside, z, yaw) for z in heights for yaw in YAWS for side in (1.0, -1.0)
    )
    return all(model.inverse(pose)[1] <= POSITION_TOLERANCE for pose in poses)
