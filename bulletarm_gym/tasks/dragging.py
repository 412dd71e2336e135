"""Waypoints for bringing a block somewhere without lifting it: a tool that tasks' experts share."""

import math
from collections.abc import Iterator, Sequence

from bulletarm_gym.geometry import Pose, planar_distance
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks.task import HALF_OPEN, Waypoint

BEHIND = 0.08
"""Where (m) the gripper comes down behind the centre of the block, as in the original BulletArm release."""
ABOVE = 0.1
"""Height (m) of the fingertips on the way to it."""
ASTRAY = 0.035
"""Distance (m) from the line to the goal at which a drag is begun anew."""


class Drag:
    """One block being brought to a goal by a gripper behind it.

    The gripper does not turn: with the fingers apart it pushes straight enough in any direction, and where it
    should turn by a right angle, either way would do, which an agent cannot imitate.

    :param block: where the block is
    :param goal: where its centre is to come (m)
    :param low: height (m) of the fingertips while they drag
    """

    def __init__(self, scene: Scene, block: Pose, goal: Sequence[float], low: float) -> None:
        self._hand = scene.robot.pose
        self._goal = goal
        self._block = block
        self._low = low
        dx, dy = goal[0] - block.x, goal[1] - block.y
        length = math.hypot(dx, dy)
        self._line = (dx / length, dy / length)
        self._start = (block.x - BEHIND * self._line[0], block.y - BEHIND * self._line[1])
        self._outside = _distance_outside(self._start, scene.config.workspace)

    @property
    def effort(self) -> float:
        """How far (m) the gripper would have to go; being behind the block already counts most."""
        if self._is_behind:
            return -1.0
        return 10.0 * self._outside + planar_distance(self._start, self._hand.position)

    @property
    def _is_behind(self) -> bool:
        """Whether the gripper is in place to drag."""
        dx, dy = self._hand.x - self._block.x, self._hand.y - self._block.y
        along = dx * self._line[0] + dy * self._line[1]
        aside = abs(dx * self._line[1] - dy * self._line[0])
        return along < 0.0 and aside < ASTRAY and self._hand.z < self._low + 0.01 and -along < 2.0 * BEHIND

    @property
    def _is_over_start(self) -> bool:
        return planar_distance(self._start, self._hand.position) < 0.01 + 1.5 * self._outside

    def plan(self) -> Iterator[Waypoint]:
        """Yield what remains of: over the start, down, to the goal."""
        if not self._is_behind:
            if not self._is_over_start:
                if self._hand.z < ABOVE - 0.04:
                    yield Waypoint(Pose.planar(self._hand.x, self._hand.y, ABOVE, self._hand.yaw), HALF_OPEN)
                yield Waypoint(Pose.planar(*self._start, ABOVE, self._hand.yaw), HALF_OPEN)
            yield Waypoint(Pose.planar(*self._start, self._low, self._hand.yaw), HALF_OPEN)
        yield Waypoint(
            Pose.planar(self._goal[0], self._goal[1], self._low, self._hand.yaw), HALF_OPEN, straight=True
        )


def _distance_outside(point: tuple[float, float], workspace: list[list[float]]) -> float:
    """Return how far (m) a point is beyond the border in x or y, 0 inside."""
    return max(
        max(low - value, value - high, 0.0) for value, (low, high) in zip(point, workspace, strict=False)
    )
