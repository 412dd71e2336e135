"""Waypoints that push or pull a block to a goal without lifting it."""

import math
from collections.abc import Iterator, Sequence

from bulletarm_gym.experts import HALF_OPEN, Waypoint
from bulletarm_gym.geometry import Pose, planar_distance
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.surfaces.surface import Point

CLEARANCE = 0.06
"""Distance (m) from the block's side at which the gripper descends behind it."""
HOVER = 0.1
"""Height (m) of the fingertips before the descent."""
AT_START = 0.01
"""Horizontal distance (m) from the start within which the gripper descends to the block's height."""
SLOPE = 1.2
"""Height of the fingertips per metre from the start: a continuous path is easier to imitate than a step."""
HEIGHT_TOLERANCE = 0.03
"""Height (m) below that path from which the gripper first moves up."""
LOOK_AHEAD = 0.04
"""Length (m) of a step over a sloping surface."""
BAND = 0.02
"""Largest height (m) of the fingertips above the height of a drag."""
OFF_LINE = 0.035
"""Largest distance (m) of the gripper from the line to the goal during a drag."""


class Drag:
    """Plan that moves one block to a goal with the gripper behind it.

    The gripper does not rotate: half-open fingers push straight enough in any direction. With a rotation by
    pi/2 two yaws would be equivalent, and an agent cannot imitate the choice.

    :param obj: the block
    :param goal: position (m) for its centre
    :param low: height (m) of the fingertips above the surface during the drag
    """

    def __init__(self, scene: Scene, obj: SceneObject, goal: Sequence[float], low: float) -> None:
        self._tool = scene.robot.pose
        self._half_width = scene.robot.model.gripper.half_width(HALF_OPEN)
        self._goal = goal
        self._block = block = obj.pose
        self._behind = obj.spec.extents[0] / 2.0 + CLEARANCE
        self._low = low
        self._surface = scene.surface
        dx, dy = goal[0] - block.x, goal[1] - block.y
        length = math.hypot(dx, dy)
        self._line = (dx / length, dy / length)
        self._start = (block.x - self._behind * self._line[0], block.y - self._behind * self._line[1])
        self._outside = _distance_outside(self._start, scene.config.workspace)

    @property
    def effort(self) -> float:
        """Cost of the path to the start: its length (m), more outside the workspace, -1 behind the block."""
        if self._is_behind:
            return -1.0
        return 10.0 * self._outside + planar_distance(self._start, self._tool.position)

    @property
    def _is_behind(self) -> bool:
        """Whether the gripper is at a pose from which the drag can start."""
        dx, dy = self._tool.x - self._block.x, self._tool.y - self._block.y
        along = dx * self._line[0] + dy * self._line[1]
        aside = abs(dx * self._line[1] - dy * self._line[0])
        return (
            along < 0.0
            and aside < OFF_LINE
            and self._tool.z < self._drag_height(self._tool.position) + BAND
            and -along < 2.0 * self._behind
        )

    @property
    def _approach_height(self) -> float:
        """Height (m) of the fingertips before the drag, lower near the start."""
        apart = planar_distance(self._start, self._tool.position) - AT_START - self._outside
        low = self._drag_height(self._start)
        return min(HOVER + low - self._low, low + SLOPE * max(0.0, apart))

    def _drag_height(self, point: Sequence[float]) -> float:
        """Return the height (m) of the fingertips at a point of the drag."""
        aside = self._half_width * math.cos(self._tool.yaw), self._half_width * math.sin(self._tool.yaw)
        under = [(point[0] + share * aside[0], point[1] + share * aside[1]) for share in (-1.0, 0.0, 1.0)]
        return self._low + float(self._surface.heights(under).max())

    def plan(self) -> Iterator[Waypoint]:
        """Yield the remaining waypoints: above the start, down, to the goal."""
        tool = self._tool
        if not self._is_behind:
            if tool.z < self._approach_height - HEIGHT_TOLERANCE:
                yield Waypoint(Pose.planar(tool.x, tool.y, HOVER, tool.yaw), HALF_OPEN)
            yield Waypoint(Pose.planar(*self._start, self._approach_height, tool.yaw), HALF_OPEN)
        yield Waypoint(self._next(), HALF_OPEN, straight=True)

    def _next(self) -> Pose:
        """Return the next pose of the drag: the goal, or on a sloping surface a short step."""
        goal, tool = self._goal, self._tool
        share = min(1.0, LOOK_AHEAD / max(planar_distance(goal, tool.position), 1e-9))
        near = (tool.x + share * (goal[0] - tool.x), tool.y + share * (goal[1] - tool.y))
        here, there, end = (self._drag_height(point) for point in (tool.position, near, goal))
        if here == there == end:
            return Pose.planar(goal[0], goal[1], end, tool.yaw)
        return Pose.planar(*near, there, tool.yaw)


def _distance_outside(point: Point, workspace: list[list[float]]) -> float:
    """Return the distance (m) of a point beyond the border in x or y, 0 inside."""
    return max(
        max(low - value, value - high, 0.0) for value, (low, high) in zip(point, workspace, strict=False)
    )
