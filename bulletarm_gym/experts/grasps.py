"""Grasps from above on whatever lies there, found in heightmaps: what a clutter's expert plans with.

A parallel gripper comes straight down on a point at some yaw. Its fingers must find room beside the target,
nothing else may be between them, and where they meet the target it must be steep and square to them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.compilation import compiled
from bulletarm_gym.geometry import FloatArray, IntArray
from bulletarm_gym.robots.gripper import Gripper

YAWS = 12
"""Directions tried over half a turn."""
DEPTHS = (0.04, 0.025, 0.014)
"""How far (m) below the highest point between the fingers their tips may go: deep grasps hold best."""
SPACING = 6
"""Pixels between the points tried."""
BESIDE = 0.004
"""Gap (m) kept between the fingers' outline and everything they pass on the way down."""
BELOW = 0.002
"""Least gap (m) between the fingertips and what is under them."""
OVERLAP = 0.005
"""A surface this far (m) above the fingertips is between the fingers, not under them."""
FRAGMENT = 0.5
"""Share of the fingers' width in which there must be something to press on."""
SKEW = 0.7
"""Sides of the target may be turned against the fingers by this slope (35 degrees) ..."""
EDGE = 0.007
"""... and must stand this high (m) above the fingertips where they meet the fingers."""

WORTH = 0.3
WORTH_SKEW = 0.12
WORTH_EDGE = 1.5
WORTH_WIDTH = 0.02
"""Quality of a grasp, less for its skew, more for its edge (a metre) and its share of the fingers."""
TALL = 0.03
"""Edges higher than this (m) are no better."""


@dataclass(frozen=True)
class Relief:
    """Heights of a square of the scene, with one layer an item.

    :param layers: (n, size, size) heights (m) of each item alone, 0 where it is not
    :param ground: (size, size) heights (m) of all else
    :param centre: world x and y of the middle (m)
    :param extent: side of the square (m)
    """

    layers: NDArray[np.float32]
    ground: NDArray[np.float32]
    centre: tuple[float, float]
    extent: float

    @property
    def pitch(self) -> float:
        """Side of a pixel (m)."""
        return self.extent / len(self.ground)

    def top_between(self, first: Sequence[float], second: Sequence[float], reach: float) -> float:
        """Return the greatest height (m) of an item between two points, ``reach`` (m) more at every side."""
        rows, columns = (self._span(first[axis], second[axis], reach, axis) for axis in (0, 1))
        return float(self.layers[:, rows, columns].max())

    def _span(self, first: float, second: float, reach: float, axis: int) -> slice:
        low, high = min(first, second) - reach, max(first, second) + reach
        return slice(self._pixel(low, axis), self._pixel(high, axis) + 1)

    def _pixel(self, value: float, axis: int) -> int:
        size = len(self.ground)
        return min(max(int((value - self.centre[axis] + self.extent / 2.0) / self.pitch), 0), size - 1)


def find_grasps(
    relief: Relief,
    gripper: Gripper,
    yaws: Sequence[float],
    lowest: float,
    depths: Sequence[float] = DEPTHS,
) -> FloatArray:
    """Return the grasps that have room.

    :param yaws: directions (rad) in which the fingers may open
    :param lowest: height (m) below which the fingertips may not go
    :param depths: how far (m) below the highest point between the fingers their tips may go
    :return: (n, 5): x, y, z (m) and yaw (rad) of the fingertips, quality: up to 0.35
    """
    objects = relief.layers.max(axis=0)
    owner = np.where(objects >= relief.ground, relief.layers.argmax(axis=0), -1).astype(np.int32)
    size = np.array([gripper.stroke / 2.0, gripper.finger[0], gripper.finger[1] / 2.0, BESIDE]) / relief.pitch
    found: FloatArray = _search(
        np.maximum(objects, relief.ground), owner, size, np.array(yaws), np.array(depths), lowest
    )
    middle = (objects.shape[0] - 1) / 2.0
    found[:, :2] = (found[:, :2] - middle) * relief.pitch + relief.centre
    return found


Heights = NDArray[np.float32]
Frame = tuple[float, float, float, float]
"""Row and column (pixels) of a gripper's middle, cosine and sine of its yaw."""


@compiled
def _search(
    heights: Heights, owner: IntArray, size: FloatArray, yaws: FloatArray, depths: FloatArray, lowest: float
) -> FloatArray:
    """Try every SPACING-th pixel of every item at every yaw and depth; :func:`find_grasps` in pixels.

    :param size: half stroke, thickness and half width of a finger, gap beside it
    """
    rows = [(0.0, 0.0, 0.0, 0.0, 0.0)]
    for i in range(SPACING // 2, heights.shape[0], SPACING):
        for j in range(SPACING // 2, heights.shape[1], SPACING):
            if owner[i, j] < 0:
                continue
            for yaw in yaws:
                frame = (float(i), float(j), math.cos(yaw), math.sin(yaw))
                top = _highest(heights, owner, owner[i, j], frame, size)
                for depth in depths:
                    tip = max(lowest, top - depth)
                    middle, quality = _judge(heights, owner, owner[i, j], frame, size, tip)
                    if quality > 0.0:
                        rows.append((i + middle * frame[2], j + middle * frame[3], tip, yaw, quality))
    return np.array(rows)[1:]


@compiled
def _pixel(heights: Heights, frame: Frame, along: float, across: float) -> tuple[int, int]:
    """Return the pixel at a place in a gripper's frame, (-1, -1) outside the image."""
    row = int(np.rint(frame[0] + along * frame[2] - across * frame[3]))
    column = int(np.rint(frame[1] + along * frame[3] + across * frame[2]))
    inside = 0 <= row < heights.shape[0] and 0 <= column < heights.shape[1]
    return (row, column) if inside else (-1, -1)


@compiled
def _highest(heights: Heights, owner: IntArray, target: int, frame: Frame, size: FloatArray) -> float:
    """Return the height (m) of the target's highest point between the open fingers."""
    reach, lines, top = int(size[0]), int(size[2]) + 1, 0.0
    for across in range(-lines, lines + 1):
        for along in range(-reach, reach + 1):
            row, column = _pixel(heights, frame, along, across)
            if row >= 0 and owner[row, column] == target:
                top = max(top, heights[row, column])
    return top


@compiled
def _judge(
    heights: Heights, owner: IntArray, target: int, frame: Frame, size: FloatArray, tip: float
) -> tuple[float, float]:
    """Return where along the opening the target's middle is, and the quality of a grasp there, 0 for none."""
    reach, lines = int(size[0]), int(size[2]) + 1
    sides = np.empty((2 * lines + 1, 4))  # first and last pixel of each line, heights there above the tips
    filled = 0
    for across in range(-lines, lines + 1):
        found = False
        for along in range(-reach, reach + 1):
            row, column = _pixel(heights, frame, along, across)
            if row < 0 or heights[row, column] <= tip + OVERLAP:
                continue
            if owner[row, column] != target:
                return 0.0, 0.0
            height = heights[row, column] - tip
            if not found:
                sides[filled, 0], sides[filled, 2] = along, height
                found = True
            sides[filled, 1], sides[filled, 3] = along, height
        filled += found
    if filled < FRAGMENT * (2 * lines + 1):
        return 0.0, 0.0
    sides = sides[:filled]
    low, high = sides[:, 0].min(), sides[:, 1].max()
    skew = (sides[:, 0].max() - low + high - sides[:, 1].min()) / (2.0 * filled)
    edge = min(sides[:, 2].mean(), sides[:, 3].mean())
    middle = 0.5 * (low + high)
    if high - low + 1.0 + 2.0 * size[3] > 2.0 * size[0] or skew > SKEW or edge < EDGE:
        return 0.0, 0.0
    if not _has_room(heights, frame, middle, size, tip - BELOW):
        return 0.0, 0.0
    return middle, WORTH - WORTH_SKEW * skew + WORTH_EDGE * min(edge, TALL) + WORTH_WIDTH * filled / (
        2 * lines + 1
    )


@compiled
def _has_room(heights: Heights, frame: Frame, middle: float, size: FloatArray, room: float) -> bool:
    """Whether nothing reaches above a height where the fingers come down on both sides of a middle."""
    lines = int(size[2]) + 2
    for step in range(int(np.ceil(size[1] + 2.0 * size[3])) + 1):
        for across in range(-lines, lines + 1):
            for side in (-1.0, 1.0):
                row, column = _pixel(heights, frame, middle + side * (size[0] - size[3] + step), across)
                if row < 0 or heights[row, column] > room:
                    return False
    return True
