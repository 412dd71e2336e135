"""Grasps from above on objects in clutter, found in an elevation map.

A parallel gripper descends vertically on a point at some yaw. Its fingers must collide with nothing, no other
object may be between them, and the target's sides must be steep and parallel to the fingers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, IntArray
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.observations import ElevationMap, HeightRenderer, Window
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.scene import Scene

YAWS = 12
"""Number of yaws over pi."""
DEPTHS = (0.04, 0.025, 0.014)
"""Depths (m) of the fingertips below the highest point between the fingers; deep grasps slip least."""
PITCH = 0.003
"""Side (m) of a pixel of the elevation map."""
SURROUNDINGS = 0.05
"""Width (m) of the strip around the workspace that the elevation map includes, for an open gripper."""
SPACING = 6
"""Distance (pixels) between the evaluated points."""
DESCENT_CLEARANCE = 0.004
"""Gap (m) between the fingers and other surfaces during the descent."""
BELOW = 0.002
"""Smallest gap (m) between the fingertips and the surface below them."""
OVERLAP = 0.005
"""Height (m) above the fingertips from which a surface is between the fingers."""

Image = NDArray[np.float32]
GripFrame = tuple[float, float, float, float]
"""Row and column (pixels) of a gripper's centre, cosine and sine of its yaw."""


@dataclass(frozen=True, kw_only=True)
class ClutterMap(ElevationMap):
    """Heights of a scene, and which of its objects they belong to.

    :param objects: (n, n) heights (m) of the objects alone, 0 elsewhere
    :param owner: (n, n) number of the highest object, -1 where something else is higher
    """

    objects: Image
    owner: IntArray

    @classmethod
    def of(cls, scene: Scene) -> "ClutterMap":
        """Return the map of the workspace and a strip around it."""
        centre, extent = scene.config.centre, scene.config.workspace_size + 2.0 * SURROUNDINGS
        renderer, window = HeightRenderer.of(scene), Window(centre, extent, round(extent / PITCH))
        labels, bodies = np.zeros((window.size, window.size), np.int16), [obj.body for obj in scene]
        objects = renderer.heights_of(bodies, window, labels)
        ground = renderer.heights_of([b for b in scene.world.obstacles if b not in bodies], window)
        number_of = {body.index: number for number, body in enumerate(bodies)}
        numbers = np.array([0, *(number_of.get(body.index, 0) for body in renderer.bodies)], np.int32)
        owner = np.where(objects >= ground, numbers[labels], -1).astype(np.int32)
        return cls(np.maximum(objects, ground), centre, extent, objects=objects, owner=owner)

    def top_between(self, first: Sequence[float], second: Sequence[float], reach: float) -> float:
        """Return the largest height (m) of an object in the box of two points, extended by ``reach`` (m)."""
        box = np.sort([first[:2], second[:2]], axis=0)
        box += np.array([[-reach], [reach]])
        corners = (box - self.centre + self.extent / 2.0) / self.resolution
        (row, column), (last_row, last_column) = corners.astype(int).clip(0, len(self.objects) - 1)
        return float(self.objects[row : last_row + 1, column : last_column + 1].max())


def find_grasps(
    clutter: ClutterMap,
    gripper: Gripper,
    yaws: Sequence[float],
    lowest: float,
    depths: Sequence[float] = DEPTHS,
) -> FloatArray:
    """Return the grasps without collisions.

    :param yaws: directions (rad) in which the fingers may open
    :param lowest: smallest height (m) of the fingertips
    :param depths: depths (m) of the fingertips below the highest point between the fingers
    :return: (n, 5) x, y, z (m) and yaw (rad) of the fingertips, and quality, up to 0.35
    """
    lengths = [gripper.stroke / 2.0, gripper.finger[0], gripper.finger[1] / 2.0, DESCENT_CLEARANCE]
    size = np.array(lengths) / clutter.resolution
    found: FloatArray = _search(
        clutter.heights, clutter.owner, size, np.array(yaws), np.array(depths), lowest
    )
    middle = (len(clutter.heights) - 1) / 2.0
    found[:, :2] = (found[:, :2] - middle) * clutter.resolution + clutter.centre
    return found


@compiled
def _search(
    heights: Image, owner: IntArray, size: FloatArray, yaws: FloatArray, depths: FloatArray, lowest: float
) -> FloatArray:
    """Return the grasps at every SPACING-th pixel of every object; x, y and ``size`` are in pixels."""
    rows = [(0.0, 0.0, 0.0, 0.0, 0.0)]
    between = np.empty((2 * (int(size[2]) + 1) + 1, 2 * int(size[0]) + 1), np.float32)
    for i in range(SPACING // 2, heights.shape[0], SPACING):
        for j in range(SPACING // 2, heights.shape[1], SPACING):
            if owner[i, j] < 0:
                continue
            for yaw in yaws:
                frame = (float(i), float(j), math.cos(yaw), math.sin(yaw))
                top, others = _gather(heights, owner, frame, owner[i, j], lowest + OVERLAP, between)
                for depth in depths:
                    tip = max(lowest, top - depth)
                    if others > tip + OVERLAP:
                        continue
                    middle, quality = _evaluate(heights, between, frame, size, tip)
                    if quality > 0.0:
                        rows.append((i + middle * frame[2], j + middle * frame[3], tip, yaw, quality))
    return np.array(rows)[1:]


@compiled
def _gather(
    heights: Image, owner: IntArray, frame: GripFrame, target: int, least: float, between: Image
) -> tuple[float, float]:
    """Write the heights (m) between the open fingers, 0 outside the map, into lines along the opening.

    :return: largest heights (m) of a target and of everything else, at least ``least``
    """
    lines, reach = between.shape[0] // 2, between.shape[1] // 2
    margin, far = lines + reach + 1, min(heights.shape) - 1
    inside = margin <= min(frame[0], frame[1]) and max(frame[0], frame[1]) <= far - margin
    top, others = least, least
    for line in range(between.shape[0]):
        across = line - lines
        down, right = across * frame[3], across * frame[2]
        for place in range(between.shape[1]):
            along = place - reach
            row = int(np.rint(frame[0] + along * frame[2] - down))
            column = int(np.rint(frame[1] + along * frame[3] + right))
            height, whose = 0.0, -1
            if inside or (0 <= row < heights.shape[0] and 0 <= column < heights.shape[1]):
                height, whose = heights[row, column], owner[row, column]
            between[line, place] = height
            if height > least and whose == target:
                top = max(top, height)
            elif height > least:
                others = max(others, height)
    return top, others


@compiled
def _evaluate(
    heights: Image, between: Image, frame: GripFrame, size: FloatArray, tip: float
) -> tuple[float, float]:
    """Return the position of the target's middle along the opening, and the quality, 0 for no grasp.

    The target must touch half of the fingers' width. Its sides must be 7 mm higher than the fingertips, and
    their slope (skew) relative to the fingers at most 0.7. The quality decreases with the skew, and increases
    with the height of the sides up to 3 cm and with the width.

    :param between: heights between the open fingers; above the tips only the target's
    """
    count, reach, filled = between.shape[0], between.shape[1] // 2, 0
    low, high, inmost_low, inmost_high = reach + 1, -reach - 1, -reach - 1, reach + 1
    left, right = 0.0, 0.0  # sums of the heights above the tips at both ends of the lines
    for line in range(count):
        above = np.flatnonzero(between[line] > tip + OVERLAP)
        if not len(above):
            continue
        first, last = above[0], above[-1]
        filled += 1
        low, inmost_low = min(low, first - reach), max(inmost_low, first - reach)
        high, inmost_high = max(high, last - reach), min(inmost_high, last - reach)
        left += between[line, first] - tip
        right += between[line, last] - tip
    if filled < 0.5 * count:
        return 0.0, 0.0
    skew = (inmost_low - low + high - inmost_high) / (2.0 * filled)
    edge, middle = min(left / filled, right / filled), 0.5 * (low + high)
    if high - low + 1.0 + 2.0 * size[3] > 2.0 * size[0] or skew > 0.7 or edge < 0.007:
        return 0.0, 0.0
    if not _fingers_pass(heights, frame, middle, size, tip - BELOW):
        return 0.0, 0.0
    return middle, 0.3 - 0.12 * skew + 1.5 * min(edge, 0.03) + 0.02 * filled / count


@compiled
def _fingers_pass(heights: Image, frame: GripFrame, middle: float, size: FloatArray, limit: float) -> bool:
    """Return True if no height below the two open fingers exceeds a limit (m)."""
    lines = int(size[2]) + 2
    for step in range(int(np.ceil(size[1] + 2.0 * size[3])) + 1):
        for across in range(-lines, lines + 1):
            for side in (-1.0, 1.0):
                along = middle + side * (size[0] - size[3] + step)
                row = int(np.rint(frame[0] + along * frame[2] - across * frame[3]))
                column = int(np.rint(frame[1] + along * frame[3] + across * frame[2]))
                if not (0 <= row < heights.shape[0] and 0 <= column < heights.shape[1]):
                    return False
                if heights[row, column] > limit:
                    return False
    return True
