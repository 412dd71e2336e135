"""Waypoints for taking hold of an item from above: a tool that tasks' experts share."""

import math
from collections.abc import Iterator

from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks.task import CLOSED, OPEN, Waypoint

STEP = 0.05
"""Farthest (m) a close-loop action moves along an axis (paper, Close-Loop 4D Benchmark)."""
ALIGNED = 0.008
"""Distance (m) in the plane at which the fingers go down beside an item without touching it ..."""
ALIGNED_YAW = 0.15
"""... and the angle (rad)."""
HOVER = 0.03
"""Height (m) of the fingertips over an item while they line up with it."""
READY = 0.9
"""Opening ratio from which the gripper is ready to grasp."""


def grasp(scene: Scene, target: Pose, top: float, symmetry: float) -> Iterator[Waypoint]:
    """Yield the way to a grasp from wherever the empty gripper is.

    Straight in where the fingers are above the item for as long as they are not aligned with it, else up,
    across and down.

    :param target: of the fingertips when they close
    :param top: height (m) of the item's highest point
    :param symmetry: turning the gripper by this angle (rad) gives as good a grasp
    """
    hand = scene.robot.pose
    turn = wrap_angle(target.yaw - hand.yaw, symmetry)
    goal = Pose.planar(*target.position, hand.yaw + turn)
    apart = max(abs(goal.x - hand.x), abs(goal.y - hand.y))
    aligned = planar_distance(goal.position, hand.position) < ALIGNED and abs(turn) < ALIGNED_YAW
    ready = scene.robot.opening_ratio > READY
    hover = top + HOVER
    if hand.z < hover and not ((aligned and ready) or _stays_above(hand.z, apart, turn, top)):
        yield Waypoint(
            Pose.planar(hand.x, hand.y, hover, hand.yaw), OPEN if hand.z > top else scene.robot.opening_ratio
        )
    if not (aligned or _stays_above(hand.z, apart, turn, top)):
        yield Waypoint(Pose.planar(goal.x, goal.y, hover, goal.yaw), OPEN)
    yield Waypoint(goal, OPEN, finish=CLOSED)


def _stays_above(height: float, apart: float, turn: float, top: float) -> bool:
    """Whether going down at full speed the fingers are over the item until they are aligned."""
    moves = max(math.ceil(apart / STEP - 1e-6), math.ceil(abs(turn) / (math.pi / 4.0) - 1e-6))
    return height - STEP * moves >= top - 1e-3
