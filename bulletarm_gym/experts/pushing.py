"""Waypoints of pushes: of a block to a goal, and of objects in a tray that no grasp can separate."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bulletarm_gym.experts import CLOSED, HALF_OPEN, Waypoint
from bulletarm_gym.experts.approach import HOVER
from bulletarm_gym.geometry import Pose, matrix, planar_distance
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.surfaces.surface import Point

CLEARANCE = 0.06
"""Distance (m) from the block's side at which the gripper descends behind it."""
DRAG_HOVER = 0.1
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
MAX_GAP = 0.9
"""Largest distance between the fingers during a drag, relative to the block's width, which must not fit."""

RUN_UP = 0.045
"""Distance (m) to an object's end at which a push starts."""
END = 0.75
"""Distance of the pushed point from an object's centre, relative to its half length."""
PUSH_HEIGHT = 0.012
"""Height (m) of the fingertips above the surface during a push."""
PUSH_LENGTH = 0.09
"""Length (m) of a push."""
TOLERANCE = 0.012
"""Largest distance (m) of the gripper from the line of a push."""
ROUND = 0.8
"""Smallest ratio of the variances across and along a round object."""
CONTACT = 0.001
"""Largest distance (m) between the gripper and a body in contact."""
SPREAD = 0.02
"""Largest sampled offset (m) of a push, so that retries differ."""


class Drag:
    """Plan that moves one block to a goal with the gripper behind it.

    The gripper does not rotate: two fingers push straight enough in any direction. With a rotation by
    pi/2 two yaws would be equivalent, and an agent cannot imitate the choice.

    :param obj: the block
    :param goal: position (m) for its centre
    :param low: height (m) of the fingertips above the surface during the drag
    """

    def __init__(self, scene: Scene, obj: SceneObject, goal: Sequence[float], low: float) -> None:
        self._tool = tool = scene.robot.pose
        gripper = scene.robot.model.gripper
        self._opening = min(HALF_OPEN, MAX_GAP * obj.spec.extents[0] / gripper.stroke)
        self._half_width = gripper.half_width(self._opening)
        self._surface, self._goal, self._low = scene.surface, goal, low
        block, behind = obj.pose, obj.spec.extents[0] / 2.0 + CLEARANCE
        dx, dy = goal[0] - block.x, goal[1] - block.y
        length = max(math.hypot(dx, dy), 1e-9)  # 0 if the block is at the goal
        line = (dx / length, dy / length)
        self._start = (block.x - behind * line[0], block.y - behind * line[1])
        limits = zip(self._start, scene.config.workspace[:2], strict=True)
        self._outside = max(max(low - value, value - high, 0.0) for value, (low, high) in limits)
        dx, dy = tool.x - block.x, tool.y - block.y
        self._is_behind = (
            -2.0 * behind < dx * line[0] + dy * line[1] < 0.0
            and abs(dx * line[1] - dy * line[0]) < OFF_LINE
            and tool.z < self._drag_height(tool.position) + BAND
        )

    @property
    def effort(self) -> float:
        """Cost of the path to the start: its length (m), more outside the workspace, -1 behind the block."""
        if self._is_behind:
            return -1.0
        return 10.0 * self._outside + planar_distance(self._start, self._tool.position)

    def _drag_height(self, point: Sequence[float]) -> float:
        aside = self._half_width * math.cos(self._tool.yaw), self._half_width * math.sin(self._tool.yaw)
        under = [(point[0] + share * aside[0], point[1] + share * aside[1]) for share in (-1.0, 0.0, 1.0)]
        return self._low + float(self._surface.heights(under).max())

    def plan(self) -> Iterator[Waypoint]:
        """Yield the remaining waypoints: above the start, down, to the goal."""
        tool = self._tool
        if not self._is_behind:
            apart = planar_distance(self._start, tool.position) - AT_START - self._outside
            low = self._drag_height(self._start)
            height = min(DRAG_HOVER + low - self._low, low + SLOPE * max(0.0, apart))
            if tool.z < height - HEIGHT_TOLERANCE:
                yield Waypoint(Pose.planar(tool.x, tool.y, DRAG_HOVER, tool.yaw), self._opening)
            yield Waypoint(Pose.planar(*self._start, height, tool.yaw), self._opening)
        yield Waypoint(self._next(), self._opening, straight=True)

    def _next(self) -> Pose:
        """Return the next pose of the drag: the goal, or on a sloping surface a short step."""
        goal, tool = self._goal, self._tool
        share = min(1.0, LOOK_AHEAD / max(planar_distance(goal, tool.position), 1e-9))
        near = (tool.x + share * (goal[0] - tool.x), tool.y + share * (goal[1] - tool.y))
        here, there, end = (self._drag_height(point) for point in (tool.position, near, goal))
        if here == there == end:
            return Pose.planar(goal[0], goal[1], end, tool.yaw)
        return Pose.planar(*near, there, tool.yaw)


def singulate(scene: Scene, obj: SceneObject, rng: np.random.Generator) -> Iterator[Waypoint]:
    """Yield waypoints that push an object's end sideways, towards the middle of the workspace.

    :param rng: samples the offset of the push
    """
    tool, low = scene.robot.pose, scene.surface.height(obj.pose.position[:2]) + PUSH_HEIGHT
    end, push = end_to_push(scene, obj)
    ahead = (end[0] - tool.x) * push[0] + (end[1] - tool.y) * push[1]
    aside = abs((end[0] - tool.x) * push[1] - (end[1] - tool.y) * push[0])
    x, y = tool.x + PUSH_LENGTH * push[0], tool.y + PUSH_LENGTH * push[1]
    is_low = tool.z < low + PUSH_HEIGHT
    if is_low and aside < SPREAD + TOLERANCE and RUN_UP - PUSH_LENGTH < ahead < 2.0 * RUN_UP:
        yield Waypoint(Pose.planar(x, y, low, tool.yaw), CLOSED, straight=True)
    arm, world = scene.robot.body, scene.world
    others = [body for body in world.obstacles if body is not arm]
    if tool.z > low + PUSH_HEIGHT and any(world.distance(arm, body, CONTACT) < CONTACT for body in others):
        # The gripper slides over the object that blocks its descent.
        yield Waypoint(Pose.planar(x, y, tool.z, tool.yaw), CLOSED, straight=True)
    shift = float(rng.uniform(-SPREAD, SPREAD))
    start = (end[0] - RUN_UP * push[0] - shift * push[1], end[1] - RUN_UP * push[1] + shift * push[0])
    hover = scene.world.top(obj.body) + HOVER
    if planar_distance(start, tool.position) > SPREAD + TOLERANCE:
        if tool.z < hover - TOLERANCE:
            yield Waypoint(Pose.planar(tool.x, tool.y, hover, tool.yaw), CLOSED)
        yield Waypoint(Pose.planar(*start, hover, tool.yaw), CLOSED)
    yield Waypoint(Pose.planar(tool.x, tool.y, low, tool.yaw), CLOSED)


def end_to_push(scene: Scene, obj: SceneObject) -> tuple[Point, Point]:
    """Return a point (m) near an end of an object, and the direction of a push across its length."""
    plane = (obj.spec.mesh.vertices @ matrix(obj.pose).T)[:, :2]
    centre = (plane.min(axis=0) + plane.max(axis=0)) / 2.0
    variances, axes = np.linalg.eigh(np.cov((plane - centre).T))
    x, y = (np.asarray(obj.pose.position[:2]) + centre).tolist()
    inward = np.asarray(scene.config.centre) - (x, y)
    distance = float(np.hypot(*inward))
    if variances[0] > ROUND * variances[1] and distance > 0.0:
        # The long axis of a round object would change with every small rotation.
        along, side = np.array((inward[1], -inward[0])) / distance, 1.0
    else:
        along = axes[:, 1]
        side = 1.0 if along @ inward >= 0.0 else -1.0
    half = float(np.abs((plane - centre) @ along).max())
    across = (-float(along[1]), float(along[0]))
    sign = 1.0 if across[0] * inward[0] + across[1] * inward[1] >= 0.0 else -1.0
    reach = END * half * side
    return (x + reach * float(along[0]), y + reach * float(along[1])), (sign * across[0], sign * across[1])
