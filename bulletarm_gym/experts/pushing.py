"""Waypoints for bringing a block somewhere without lifting it: a tool that tasks' experts share."""

import math
from collections.abc import Iterator, Sequence

from bulletarm_gym.experts.waypoints import HALF_OPEN, Waypoint
from bulletarm_gym.geometry import Pose, planar_distance
from bulletarm_gym.scene import Scene, SceneObject

CLEAR = 0.06
"""Where (m) the gripper comes down behind the block."""
ABOVE = 0.1
"""Height (m) of the fingertips on the way to it."""
AT_START = 0.01
"""Distance (m) from there within which it is right to be as low as the block ..."""
SLOPE = 1.2
"""... and by how much higher it is to be per metre farther away, without a step that is hard to see ..."""
LOOK_AHEAD = 0.04
"""How far (m) a drag over sloping ground looks ahead."""
UNDER = 0.03
"""... where this much (m) lower still does no harm."""
BAND = 0.02
"""Height (m) above that of a drag that still counts as low."""
OFF_LINE = 0.035
"""Distance (m) from the line to the goal at which a drag is begun anew."""


class Drag:
    """One block being brought to a goal by a gripper behind it.

    The gripper does not turn: with the fingers apart it pushes straight enough in any direction, and where it
    should turn by a right angle, either way would do, which an agent cannot imitate.

    :param item: the block
    :param goal: where its centre is to come (m)
    :param low: height (m) of the fingertips while they drag
    """

    def __init__(self, scene: Scene, item: SceneObject, goal: Sequence[float], low: float) -> None:
        self._hand = scene.robot.pose
        self._half_width = scene.robot.model.gripper.half_width(HALF_OPEN)
        self._goal = goal
        self._block = block = item.pose
        self._behind = item.spec.extents[0] / 2.0 + CLEAR
        self._low = low
        self._surface = scene.surface
        dx, dy = goal[0] - block.x, goal[1] - block.y
        length = math.hypot(dx, dy)
        self._line = (dx / length, dy / length)
        self._start = (block.x - self._behind * self._line[0], block.y - self._behind * self._line[1])
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
        return (
            along < 0.0
            and aside < OFF_LINE
            and self._hand.z < self._above_ground(self._hand.position) + BAND
            and -along < 2.0 * self._behind
        )

    @property
    def _height(self) -> float:
        """Height (m) to be at on the way: the nearer to the start, the lower."""
        apart = planar_distance(self._start, self._hand.position) - AT_START - self._outside
        low = self._above_ground(self._start)
        return min(ABOVE + low - self._low, low + SLOPE * max(0.0, apart))

    def _above_ground(self, point: Sequence[float]) -> float:
        """Return the height (m) at which the open fingers drag there."""
        aside = self._half_width * math.cos(self._hand.yaw), self._half_width * math.sin(self._hand.yaw)
        under = [(point[0] + share * aside[0], point[1] + share * aside[1]) for share in (-1.0, 0.0, 1.0)]
        return self._low + float(self._surface.heights(under).max())

    def plan(self) -> Iterator[Waypoint]:
        """Yield what remains of: over the start, down, to the goal."""
        if not self._is_behind:
            if self._hand.z < self._height - UNDER:
                yield Waypoint(Pose.planar(self._hand.x, self._hand.y, ABOVE, self._hand.yaw), HALF_OPEN)
            yield Waypoint(Pose.planar(*self._start, self._height, self._hand.yaw), HALF_OPEN)
        yield Waypoint(self._next(), HALF_OPEN, straight=True)

    def _next(self) -> Pose:
        """Return where the drag goes next: to the goal, over sloping ground step by step."""
        goal, hand = self._goal, self._hand
        share = min(1.0, LOOK_AHEAD / max(planar_distance(goal, hand.position), 1e-9))
        near = (hand.x + share * (goal[0] - hand.x), hand.y + share * (goal[1] - hand.y))
        here, there, end = (self._above_ground(point) for point in (hand.position, near, goal))
        if here == there == end:
            return Pose.planar(goal[0], goal[1], end, hand.yaw)
        return Pose.planar(*near, there, hand.yaw)


def _distance_outside(point: tuple[float, float], workspace: list[list[float]]) -> float:
    """Return how far (m) a point is beyond the border in x or y, 0 inside."""
    return max(
        max(low - value, value - high, 0.0) for value, (low, high) in zip(point, workspace, strict=False)
    )
