"""Observations and heights of picks and places for a real robot, from the point cloud of its cameras.

Frames and units are those of the environments: metres, the world's z axis upwards from the table's top at
z = 0, its x axis from the arm over the workspace. The environments use the same code.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WORKSPACES
from bulletarm_gym.control import Grasp, heights
from bulletarm_gym.control.close_loop import VIEW_SCALE, tool_frame
from bulletarm_gym.geometry import FloatArray, Pose, Rectangle
from bulletarm_gym.observations import MAX_HEIGHT, ElevationMap, Frame, Heights, Window
from bulletarm_gym.observations.images import heightmap
from bulletarm_gym.observations.in_hand import projections, rotated_crop
from bulletarm_gym.observations.rasterizer import project_points

Limits = Sequence[Sequence[float]]
"""Ranges of a workspace in x, y and z (m)."""
SIZE = 128
"""Pixels a side unless told, as ``obs_size`` ..."""
IN_HAND_SIZE = 24
"""... and ``in_hand_size``, which is 40 on bumps."""


def close_loop_heightmap(
    points: ArrayLike,
    hand: Pose,
    opening: float,
    workspace: Limits = WORKSPACES[CLOSE_LOOP],
    size: int = SIZE,
) -> Heights:
    """Return the heightmap of close-loop control: depths below a plane 0.10 m above the fingertips.

    :param points: (n, 3) world (m), table included, the arm's own taken out, those on what it holds left in.
        Points that are not finite, or above the workspace, are left out
    :param hand: of the middle between the fingertips, in the world; its yaw is 0 where fingers open along x
    :param opening: distance (m) between the fingers' inner sides
    :param workspace: the environment's; half as much again is seen
    :param size: pixels a side, the environment's ``obs_size``
    :return: (1, size, size) m, within [0, 0.4]; rows grow with world x, columns with y
    :raises ValueError: no point is in the square, or ``points`` has another shape
    """
    (low, high), _, (_, top) = workspace
    return _shown(points, tool_frame(hand, opening, VIEW_SCALE * (high - low)), top, size)


def open_loop_heightmap(
    points: ArrayLike, workspace: Limits = WORKSPACES[OPEN_LOOP], size: int = SIZE
) -> Heights:
    """Return the heightmap of open-loop control: heights over the workspace's floor.

    :param points: (n, 3) world (m), table included, the arm's own and what it holds taken out
    :param workspace: the environment's
    :param size: pixels a side, the environment's ``obs_size``
    :return: (1, size, size) m, within [0, 0.4]; rows grow with world x, columns with y
    :raises ValueError: no point is in the square, or ``points`` has another shape
    """
    return _shown(points, _workspace_frame(workspace), workspace[2][1], size)


def in_hand_image(
    heightmap: Heights,
    pick: Pose,
    workspace: Limits = WORKSPACES[OPEN_LOOP],
    size: int = IN_HAND_SIZE,
    tilts: bool = False,
) -> Heights:
    """Return the in-hand image of open-loop control, after a pick until the next place; else it is zeros.

    :param heightmap: (1, n, n), the last one before the pick
    :param pick: where the fingertips closed, in the world
    :param workspace: the environment's
    :param size: pixels a side, the environment's ``in_hand_size``
    :param tilts: whether actions have three r's, and the image three channels
    :return: (1, size, size) or (3, size, size) m, within [0, 0.4]
    """
    show = projections if tilts else rotated_crop
    return show(_map(heightmap, workspace), _above_floor(pick, workspace), size).clip(0.0, MAX_HEIGHT)


def pick_height(
    heightmap: Heights,
    target: Pose,
    depth: float,
    area: tuple[float, float] | None = None,
    workspace: Limits = WORKSPACES[OPEN_LOOP],
) -> float:
    """Return the height (m) of the fingertips at a pick whose action has no z.

    :param heightmap: (1, n, n), the last one
    :param target: pose of the fingertips in the world, of any z
    :param depth: depth (m) of the fingertips below the highest point of the area, the task's
        ``grasp_params.pick_offset``
    :param area: length along the opening and width (m) of the area, the task's ``grasp_params.pick_area``; by
        default a square of twice the depth
    :param workspace: the environment's
    :return: z of the target in the world
    """
    between = Rectangle(target.x, target.y, *(area or (2.0 * depth, 2.0 * depth)), target.yaw)
    return workspace[2][0] + heights.pick_height(_map(heightmap, workspace), between, depth)


def measure_grasp(
    before: Heights, after: Heights, closed_at: Pose, workspace: Limits = WORKSPACES[OPEN_LOOP]
) -> Grasp | None:
    """Return the measurements of a grasped object, or None if the heightmaps do not show its absence.

    :param before: (1, n, n), heightmap before the pick
    :param after: (1, n, n), heightmap after the pick, without the grasped object
    :param closed_at: measured pose of the fingertips in the world when they closed
    :param workspace: the environment's
    """
    tips = _above_floor(closed_at, workspace)
    return heights.measure_grasp(_map(before, workspace), _map(after, workspace), tips)


def place_height(
    heightmap: Heights,
    target: Pose,
    grasp: Grasp,
    gap: float,
    workspace: Limits = WORKSPACES[OPEN_LOOP],
) -> float:
    """Return the height (m) of the fingertips at a place whose action has no z.

    :param heightmap: (1, n, n), the last one, without the grasped object
    :param target: pose of the fingertips in the world, of any z
    :param grasp: measurements at the pick, see :func:`measure_grasp`
    :param gap: gap (m) from the object to the highest point under it, ``grasp_params.place_offset``
    :param workspace: the environment's
    :return: z of the target in the world
    """
    return workspace[2][0] + heights.place_height(_map(heightmap, workspace), target, grasp, gap)


def _map(heightmap: Heights, workspace: Limits) -> ElevationMap:
    frame = _workspace_frame(workspace)
    return ElevationMap(heightmap[0], frame.centre, frame.extent)


def _above_floor(pose: Pose, workspace: Limits) -> Pose:
    return Pose((0.0, 0.0, -workspace[2][0])).compose(pose)


def _workspace_frame(workspace: Limits) -> Frame:
    (x0, x1), (y0, y1), (floor, _) = workspace
    return Frame(Pose(((x0 + x1) / 2.0, (y0 + y1) / 2.0, floor)), x1 - x0)


def _shown(points: ArrayLike, frame: Frame, ceiling: float, size: int) -> Heights:
    cloud = _checked(points)
    if not (np.abs(cloud[:, :2] - frame.centre) < frame.extent / 2.0).all(axis=1).any():
        x, y = frame.centre
        raise ValueError(
            f"points: got {len(cloud)}, none in the square of {frame.extent:g} m about x = {x:g}, y = {y:g}; "
            "takes points of the world, in metres"
        )
    return heightmap(project_points(cloud, Window(frame.centre, frame.extent, size), ceiling), frame)


def _checked(points: ArrayLike) -> FloatArray:
    cloud: FloatArray = np.asarray(points, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"points: got an array of shape {cloud.shape}, takes (n, 3)")
    return cloud[np.isfinite(cloud).all(axis=1)]
