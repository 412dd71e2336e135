"""Ways of the fingertips through the air: how long they are, and over what they lead."""

import itertools
import math
from collections.abc import Iterator

from bulletarm_gym.geometry import Pose, conjugate, interpolate, multiply

REFERENCE_DISTANCE = 0.05
"""The close-loop step (m; paper, Close-Loop 4D Benchmark)."""
TURNING_RADIUS = 0.06
"""Lever (m) at which a turn about the tool counts as distance: half an open gripper and its fingers."""
TILTING_RADIUS = 0.25
"""Lever (m) at which a tilt counts as distance: from the fingertips to the wrist of an arm."""
MAX_SAG = 0.2
"""Largest distance of a motion from the straight line, as a share of its length."""
TRANSFER_HEIGHT = 0.4
"""Height (m) at which things are carried across a workspace where that has to be simulated."""


def stops_over(start: Pose, end: Pose) -> Iterator[Pose]:
    """Yield the poses of a way straight up and upright, across, and straight down, in short moves."""
    level = max(start.z, end.z, TRANSFER_HEIGHT)
    over = [Pose.planar(pose.x, pose.y, level, pose.yaw) for pose in (start, end)]
    for before, after in itertools.pairwise([start, *over, end]):
        count = max(1, math.ceil(distance(before, after) / REFERENCE_DISTANCE))
        yield from (interpolate(before, after, number / count) for number in range(1, count + 1))


def is_straight(start: Pose, middle: Pose, end: Pose) -> bool:
    """Return True if the middle of a motion is near the line between its ends."""
    off = math.dist(middle.position, interpolate(start, end, 0.5).position)
    return off < MAX_SAG * distance(start, end)


def distance(start: Pose, end: Pose) -> float:
    """Return how far (m) the fingertips, the fingers about them or the wrist go, whichever is farthest."""
    x, y, z, w = multiply(conjugate(start.orientation), end.orientation)
    turn = 2.0 * math.atan2(abs(z), abs(w))
    tilt = 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w))
    return max(math.dist(start.position, end.position), TURNING_RADIUS * turn, TILTING_RADIUS * tilt)
