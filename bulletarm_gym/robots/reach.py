"""Poses that an arm reaches inside its joint limits."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from bulletarm_gym.geometry import Pose, multiply, yaw_quaternion
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
FLOOR, TOPS = 0.01, (0.25, 0.18, 0.12, 0.08)
"""Lower limit and candidates for the upper limit (m) of the largest workspace."""
SIDES = tuple(np.arange(0.8, 0.09, -0.04).round(2).tolist())
"""Candidates (m) for the side length of the largest workspace."""
STEP = 0.04
"""Distance (m) between two candidates for its position."""


def reaches(model: RobotModel, pose: Pose) -> bool:
    """Return True if a pose is in reach."""
    return model.inverse(pose)[1] <= POSITION_TOLERANCE


def reach_share(model: RobotModel, poses: Iterable[Pose]) -> float:
    """Return the fraction of poses in reach."""
    return float(np.mean([reaches(model, pose) for pose in poses]))


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


def largest_workspace(model: RobotModel) -> Limits | None:
    """Return the limits (m) of the largest workspace in front of the base in reach of the upright gripper."""
    length = float(np.linalg.norm(model.chain.translations[1:], axis=1).sum())
    x, y, _ = model.base.position
    for top, side in itertools.product(TOPS, SIDES):
        for near in np.arange(x + STEP, x + length - side, STEP).round(3).tolist():
            limits = [[near, near + side], [y - side / 2.0, y + side / 2.0], [FLOOR, top]]
            heights = (FLOOR, (FLOOR + top) / 2.0, top)
            if all(reaches(model, pose) for pose in grid(limits, heights, 3)):
                return np.round(limits, 3).tolist()  # type: ignore[no-any-return]
    return None
