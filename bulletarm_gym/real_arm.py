"""Observations and heights of picks and places for a real robot, from the point cloud of its cameras.

Frames and units are the same as in the environments: metres in the world, z upwards from the table's top, x
from the robot to the workspace. ``workspace`` contains the limits along x, y and z. ``size`` is the side
length of an image in pixels. The environments use the same code.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.benchmarks import IN_HAND
from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WORKSPACES
from bulletarm_gym.config_checks import check_argument, integer, numbers, rule
from bulletarm_gym.config_checks import workspace as limits
from bulletarm_gym.control.close_loop import VIEW_SCALE, tool_frame
from bulletarm_gym.control.open_loop import measure_grasp, pick_height, place_height, workspace_frame
from bulletarm_gym.geometry import Pose
from bulletarm_gym.geometry.poses import pose_check
from bulletarm_gym.observations import ElevationMap, Frame, Heights, Window, images
from bulletarm_gym.observations.rasterizer import project_points

__all__ = [
    "close_loop_heightmap",
    "elevation_map",
    "in_hand_image",
    "measure_grasp",
    "open_loop_heightmap",
    "pick_height",
    "place_height",
]

Limits = Sequence[Sequence[float]]
"""Limits (m) of a workspace along x, y and z."""
SIZE = 128
"""Default side length (pixels) of heightmaps, ``obs_size``."""

POINTS = rule("an array of numbers", lambda cloud: cloud.dtype.kind in "iuf", np.asarray)
"""Check of points of any shape."""
HEIGHTMAP = rule(
    "an array of finite numbers (m) of shape (1, n, n)",
    lambda image: image.shape == (1, *[len(image[0])] * 2) and image.size and np.isfinite(image).all(),
    lambda image: np.asarray(image, np.float32),
)
"""Check of heightmaps."""


def close_loop_heightmap(
    points: ArrayLike,
    tool_pose: Pose,
    opening: float,
    workspace: Limits = WORKSPACES[CLOSE_LOOP],
    size: int = SIZE,
) -> Heights:
    """Return the heightmap of closed-loop control: depths below a plane 0.10 m above the fingertips.

    :param points: (n, 3) points (m, world) with the table and the grasped object, without the robot. Points
        that are not finite or above the workspace are ignored
    :param tool_pose: pose between the fingertips; its yaw is 0 if the fingers open along x
    :param opening: distance (m) between the inner sides of the fingers
    :param workspace: limits (m); the heightmap is 1.5 times as large
    :return: (1, size, size) m, within [0, 0.4]; rows grow with world x, columns with y
    :raises ValueError: no point is in the square, or an argument has another shape or type
    """
    tool_pose = check_argument("tool_pose", tool_pose, pose_check)
    opening = check_argument("opening", opening, numbers("non-negative"))
    (low, high), _, (_, top) = check_argument("workspace", workspace, limits)
    return _heightmap(points, tool_frame(tool_pose, opening, VIEW_SCALE * (high - low)), top, size)


def open_loop_heightmap(
    points: ArrayLike, workspace: Limits = WORKSPACES[OPEN_LOOP], size: int = SIZE
) -> Heights:
    """Return the heightmap of open-loop control: heights above the workspace's floor.

    :param points: (n, 3) points (m, world) with the table, without the robot and the grasped object
    :return: (1, size, size) m, within [0, 0.4]; rows grow with world x, columns with y
    :raises ValueError: no point is in the square, or an argument has another shape or type
    """
    workspace = check_argument("workspace", workspace, limits)
    return _heightmap(points, workspace_frame(workspace), workspace[2][1], size)


def in_hand_image(
    heightmap: Heights,
    pick: Pose,
    workspace: Limits = WORKSPACES[OPEN_LOOP],
    size: int = IN_HAND,
    tilts: bool = False,
) -> Heights:
    """Return the in-hand image of open-loop control from a pick to the next place. At other times it is zero.

    :param heightmap: (1, n, n), heightmap before the pick
    :param pick: target pose (world) of the pick, with the theta of the action, see ``PickPlace.pose``
    :param size: side length (pixels) of the image, ``in_hand_size``; 40 on bumps
    :param tilts: whether actions have three r's and the image three channels
    :return: (1, size, size) or (3, size, size) m, within [0, 0.4]
    :raises ValueError: an argument has another shape or type
    """
    pick = check_argument("pick", pick, pose_check)
    size = check_argument("size", size, integer(1))
    return images.in_hand_image(elevation_map(heightmap, workspace), pick, size, tilts)


def elevation_map(heightmap: Heights, workspace: Limits = WORKSPACES[OPEN_LOOP]) -> ElevationMap:
    """Return a heightmap of open-loop control, (1, n, n), as a map of the world.

    :func:`pick_height`, :func:`measure_grasp` and :func:`place_height` return heights for actions without z.

    :raises ValueError: ``heightmap`` has another shape, or ``workspace`` is not one of an environment
    """
    frame = workspace_frame(check_argument("workspace", workspace, limits))
    image = check_argument("heightmap", heightmap, HEIGHTMAP)
    return ElevationMap(image[0], frame.centre, frame.extent, frame.origin.z)


def _heightmap(points: ArrayLike, frame: Frame, ceiling: float, size: int) -> Heights:
    cloud = check_argument("points", points, POINTS).astype(np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"points must be an array of shape (n, 3), got {cloud.shape}")
    check_argument("size", size, integer(1))
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if not (np.abs(cloud[:, :2] - frame.centre) < frame.extent / 2.0).all(axis=1).any():
        x, y = frame.centre
        raise ValueError(
            f"points must be world coordinates (m), some in the square of {frame.extent:g} m around "
            f"x = {x:g}, y = {y:g}, got {len(cloud)} outside"
        )
    return images.heightmap(project_points(cloud, Window(frame.centre, frame.extent, size), ceiling), frame)
