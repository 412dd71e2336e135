"""Turning what lies in a tray with the tip of the closed gripper, where nothing can be grasped as it lies."""

from collections.abc import Iterator

import numpy as np

from bulletarm_gym.experts.approach import HOVER
from bulletarm_gym.experts.waypoints import CLOSED, Waypoint
from bulletarm_gym.geometry import Pose, matrix, planar_distance
from bulletarm_gym.scene import Scene, SceneObject

RUN_UP = 0.045
"""Distance (m) beside an item from which one of its ends is pushed."""
END = 0.75
"""Share of an item's half length at which it is pushed."""
PUSH_HEIGHT = 0.012
"""Height (m) of the fingertips above the ground while they push."""
STROKE = 0.09
"""How far (m) an end is pushed."""
OFF_PUSH = 0.012
"""A gripper this far (m) off the line of the push has left it."""
ROUND = 0.8
"""What is as wide as this share of its length, as variances go, counts as round."""
TOUCH = 0.001
"""Distance (m) at which the gripper counts as touching."""
SPREAD = 0.02
"""Spread (m) of where the push begins, so that no two tries are alike."""


def stir(scene: Scene, item: SceneObject, rng: np.random.Generator) -> Iterator[Waypoint]:
    """Yield the way of pushing an end of an item across its length, towards the middle of the workspace.

    :param rng: moves the start of the push
    """
    hand, low = scene.robot.pose, scene.surface.height(item.pose.position[:2]) + PUSH_HEIGHT
    end, push = _end_to_push(scene, item)
    ahead = (end[0] - hand.x) * push[0] + (end[1] - hand.y) * push[1]
    aside = abs((end[0] - hand.x) * push[1] - (end[1] - hand.y) * push[0])
    if hand.z < low + PUSH_HEIGHT and aside < SPREAD + OFF_PUSH and RUN_UP - STROKE < ahead < 2.0 * RUN_UP:
        beyond = Pose.planar(hand.x + STROKE * push[0], hand.y + STROKE * push[1], low, hand.yaw)
        yield Waypoint(beyond, CLOSED, straight=True)
    if hand.z > low + PUSH_HEIGHT and _stands_on_something(scene):
        # What stops the gripper on its way down it rubs along instead
        across = Pose.planar(hand.x + STROKE * push[0], hand.y + STROKE * push[1], hand.z, hand.yaw)
        yield Waypoint(across, CLOSED, straight=True)
    shift = float(rng.uniform(-SPREAD, SPREAD))
    start = (end[0] - RUN_UP * push[0] - shift * push[1], end[1] - RUN_UP * push[1] + shift * push[0])
    hover = scene.world.top(item.body) + HOVER
    if planar_distance(start, hand.position) > SPREAD + OFF_PUSH:
        if hand.z < hover - OFF_PUSH:
            yield Waypoint(Pose.planar(hand.x, hand.y, hover, hand.yaw), CLOSED)
        yield Waypoint(Pose.planar(*start, hover, hand.yaw), CLOSED)
    yield Waypoint(Pose.planar(hand.x, hand.y, low, hand.yaw), CLOSED)


def _stands_on_something(scene: Scene) -> bool:
    """Whether the gripper touches an object, or a wall."""
    arm, world = scene.robot.body, scene.world
    solids = (body for body in world.obstacles if body is not arm)
    return any(world.distance(arm, body, TOUCH) < TOUCH for body in solids)


def _end_to_push(scene: Scene, item: SceneObject) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return an end of an item and the direction across its length that leads to the middle."""
    plane = (item.spec.mesh.vertices @ matrix(item.pose).T)[:, :2]
    centre = (plane.min(axis=0) + plane.max(axis=0)) / 2.0
    spread, axes = np.linalg.eigh(np.cov((plane - centre).T))
    x, y = (np.asarray(item.pose.position[:2]) + centre).tolist()
    inward = np.asarray(scene.config.centre) - (x, y)
    distance = float(np.hypot(*inward))
    if spread[0] > ROUND * spread[1] and distance > 0.0:
        # A round thing has no length of its own: it would change with every hair's breadth.
        along, side = np.array((inward[1], -inward[0])) / distance, 1.0
    else:
        along = axes[:, 1]
        side = 1.0 if along @ inward >= 0.0 else -1.0
    half = float(np.abs((plane - centre) @ along).max())
    across = (-float(along[1]), float(along[0]))
    sign = 1.0 if across[0] * inward[0] + across[1] * inward[1] >= 0.0 else -1.0
    reach = END * half * side
    return (x + reach * float(along[0]), y + reach * float(along[1])), (sign * across[0], sign * across[1])
