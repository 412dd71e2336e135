"""Heights of picks and places whose action has no z, from heightmaps alone.

Heights are above the zero of the heightmap, in open loop the workspace's floor.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from bulletarm_gym.geometry import Pose, Rectangle, matrix
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.rasterizer import rectangle_mask

MIN_PICK_HEIGHT = 0.005
"""Smallest height (m) of a pick."""
REMOVED = 0.002
"""Smallest decrease (m) of a pixel's height at a pick that shows the absence of the grasped object."""
GRASP_RADIUS = 0.05
"""Largest distance (m) of the fingertips from the nearest pixel of the grasped object."""


class Grasp(NamedTuple):
    """Measurements of a grasped object at its pick.

    The footprint is a rectangle in the frame of the fingertips, whose x axis is the opening direction.

    :param height: height (m) of the fingertips above the object's lower side
    :param x: middle of the footprint along x (m)
    :param y: middle of the footprint along y (m)
    :param length: side of the footprint along x (m)
    :param width: side of the footprint along y (m)
    """

    height: float
    x: float
    y: float
    length: float
    width: float


def pick_height(
    heights: ElevationMap, target: Pose, depth: float, area: tuple[float, float] | None = None
) -> float:
    """Return the height (m) of the fingertips at a pick.

    :param heights: last heightmap
    :param target: pose of the fingertips; its z and tilt do not matter
    :param depth: depth (m) of the fingertips below the highest point of the area
    :param area: length along the opening and width (m) of the area; by default a square of twice the depth
    """
    between = Rectangle(target.x, target.y, *(area or (2.0 * depth, 2.0 * depth)), target.yaw)
    return max(_highest(heights, between) - depth, MIN_PICK_HEIGHT)


def measure_grasp(before: ElevationMap, after: ElevationMap, closed_at: Pose) -> Grasp | None:
    """Return the measurements of the grasped object, or None if the heightmaps do not show its absence.

    The footprint consists of the connected pixels that the pick lowered. The surface that supported the
    object, the floor or another object, is the highest of these pixels after the pick.

    :param before: heightmap before the pick
    :param after: heightmap after the pick, without the grasped object
    :param closed_at: pose of the fingertips when they closed, its z above the zero of the heightmaps
    """
    removed = before.heights - after.heights > REMOVED
    if not removed.any():
        return None
    pixels = np.argwhere(removed)
    distances = np.linalg.norm(pixels - before.pixels(np.array(closed_at.position)), axis=1)
    nearest = int(distances.argmin())
    if distances[nearest] * before.resolution > GRASP_RADIUS:
        return None
    regions, _ = label(removed, np.ones((3, 3)))
    footprint = regions == regions[tuple(pixels[nearest])]
    points = before.points(np.argwhere(footprint)) - closed_at.position[:2]
    points = points @ matrix(Pose.planar(0.0, 0.0, 0.0, closed_at.yaw))[:2, :2]
    (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    height = closed_at.z - float(after.heights[footprint].max())
    return Grasp(height, (x0 + x1) / 2.0, (y0 + y1) / 2.0, x1 - x0, y1 - y0)


def place_height(heights: ElevationMap, target: Pose, grasp: Grasp, gap: float) -> float:
    """Return the height (m) of the fingertips at a place.

    :param heights: last heightmap, without the grasped object
    :param target: pose of the fingertips; its z and tilt do not matter
    :param grasp: measurements at the pick
    :param gap: distance (m) between the object and the highest point under it
    """
    x, y, _ = Pose.planar(target.x, target.y, 0.0, target.yaw).transform((grasp.x, grasp.y, 0.0))
    footprint = Rectangle(x, y, grasp.length, grasp.width, target.yaw)
    return _highest(heights, footprint) + grasp.height + gap


def _highest(heights: ElevationMap, area: Rectangle) -> float:
    """Return the greatest height (m) of the pixels in an area and of the pixel at its middle."""
    covered = rectangle_mask(heights.window, [area])
    row, column = heights.pixels(np.array((area.x, area.y))).round().astype(int).clip(0, len(covered) - 1)
    covered[row, column] = True
    return float(heights.heights[covered].max())
