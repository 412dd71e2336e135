"""Lengths, shapes and durations of tool paths."""

import itertools
import math
from collections.abc import Iterator

from bulletarm_gym.geometry import Pose, conjugate, interpolate, multiply

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
