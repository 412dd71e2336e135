"""Singulation: pushes that separate objects in a tray where no grasp is possible."""

from collections.abc import Iterator

import numpy as np

from bulletarm_gym.experts import CLOSED, Waypoint
from bulletarm_gym.experts.approach import HOVER
from bulletarm_gym.geometry import Pose, matrix, planar_distance
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.surfaces.surface import Point

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
    if tool.z > low + PUSH_HEIGHT and _is_in_contact(scene):
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


def _is_in_contact(scene: Scene) -> bool:
    """Return True if the gripper touches an object or a wall."""
    arm, world = scene.robot.body, scene.world
    return any(world.distance(arm, body, CONTACT) < CONTACT for body in world.obstacles if body is not arm)


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
