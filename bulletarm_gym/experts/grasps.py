"""Grasps from above on whatever lies there, found in heightmaps: what a clutter's expert plans with.

A parallel gripper comes straight down on a point at some yaw. Its fingers must find room beside the target,
nothing else may be between them, and where they meet the target it must be steep and square to them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, IntArray, Pose
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.robots.gripper import Gripper

YAWS = 12
"""Directions tried over half a turn."""
DEPTHS = (0.04, 0.025, 0.014)
"""How far (m) below the highest point between the fingers their tips may go: deep grasps hold best."""
SPACING = 6
"""Pixels between the points tried."""
DESCENT_CLEARANCE = 0.004
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
class ElevationLayers:
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


@dataclass(frozen=True)
class Grasps:
    """Poses of an upright gripper, its fingertips where they close; all arrays (n,).

    :param x: m
    :param y: m
    :param z: m
    :param yaw: along which the fingers open (rad)
    :param quality: up to 0.35
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    yaw: FloatArray
    quality: FloatArray

    def __len__(self) -> int:
        return len(self.quality)

    def at(self, number: int) -> Pose:
        """Return one of the poses."""
        x, y, z, yaw = (float(values[number]) for values in (self.x, self.y, self.z, self.yaw))
        return Pose.planar(x, y, z, yaw)

    def within(self, limits: Sequence[Sequence[float]]) -> "Grasps":
        """Return those inside [[x low, x high], [y low, y high]] (m)."""
        (x0, x1), (y0, y1) = limits
        inside = (self.x > x0) & (self.x < x1) & (self.y > y0) & (self.y < y1)
        columns = (self.x, self.y, self.z, self.yaw, self.quality)
        return Grasps(*(column[inside] for column in columns))


def find_grasps(
    relief: ElevationLayers,
    gripper: Gripper,
    yaws: Sequence[float],
    lowest: float,
    depths: Sequence[float] = DEPTHS,
) -> Grasps:
    """Return the grasps that have room.

    :param yaws: directions (rad) in which the fingers may open
    :param lowest: height (m) below which the fingertips may not go
    :param depths: how far (m) below the highest point between the fingers their tips may go
    """
    objects, owner = _uppermost(relief.layers, relief.ground)
    size = (
        np.array([gripper.stroke / 2.0, gripper.finger[0], gripper.finger[1] / 2.0, DESCENT_CLEARANCE])
        / relief.pitch
    )
    found: FloatArray = _search(
        np.maximum(objects, relief.ground), owner, size, np.array(yaws), np.array(depths), lowest
    )
    middle = (objects.shape[0] - 1) / 2.0
    found[:, :2] = (found[:, :2] - middle) * relief.pitch + relief.centre
    return Grasps(*found.T)


Heights = NDArray[np.float32]
Layers = NDArray[np.float32]
Frame = tuple[float, float, float, float]
"""Row and column (pixels) of a gripper's middle, cosine and sine of its yaw."""


@compiled
def _uppermost(layers: Layers, ground: Heights) -> tuple[Heights, IntArray]:
    """Return the greatest height (m) of an item at each pixel, and the number of the item, -1 for none."""
    objects, owner = layers[0].copy(), np.zeros(ground.shape, np.int32)
    for number in range(1, len(layers)):
        for row in range(ground.shape[0]):
            for column in range(ground.shape[1]):
                height, higher = layers[number, row, column], objects[row, column]
                owner[row, column] = number if height > higher else owner[row, column]
                objects[row, column] = height if height > higher else higher
    return objects, np.where(objects >= ground, owner, np.int32(-1))


@compiled
def _search(
    heights: Heights, owner: IntArray, size: FloatArray, yaws: FloatArray, depths: FloatArray, lowest: float
) -> FloatArray:
    """Try every SPACING-th pixel of every item at every yaw and depth; :class:`Grasps` in pixels, (n, 5).

    :param size: half stroke, thickness and half width of a finger, gap beside it
    """
    rows = [(0.0, 0.0, 0.0, 0.0, 0.0)]
    between = np.empty((2 * (int(size[2]) + 1) + 1, 2 * int(size[0]) + 1), np.float32)
    whose = np.empty(between.shape, np.int32)
    for i in range(SPACING // 2, heights.shape[0], SPACING):
        for j in range(SPACING // 2, heights.shape[1], SPACING):
            if owner[i, j] < 0:
                continue
            for yaw in yaws:
                frame = (float(i), float(j), math.cos(yaw), math.sin(yaw))
                _gather(heights, owner, frame, between, whose)
                top, others = _tops(between, whose, owner[i, j], lowest + OVERLAP)
                for depth in depths:
                    tip = max(lowest, top - depth)
                    if others > tip + OVERLAP:
                        continue
                    middle, quality = _judge(heights, between, frame, size, tip)
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
def _gather(heights: Heights, owner: IntArray, frame: Frame, between: Heights, whose: IntArray) -> None:
    """Write heights (m) and owners between the open fingers, line by line; outside the image 0 and -1.

    :param between: (lines, places), of the fingers' width and of their opening
    :param whose: of the same shape
    """
    lines, reach = between.shape[0] // 2, between.shape[1] // 2
    margin, far = lines + reach + 1, min(heights.shape) - 1
    inside = margin <= min(frame[0], frame[1]) and max(frame[0], frame[1]) <= far - margin
    for line in range(between.shape[0]):
        across = line - lines
        down, right = across * frame[3], across * frame[2]
        for place in range(between.shape[1]):
            along = place - reach
            row = int(np.rint(frame[0] + along * frame[2] - down))
            column = int(np.rint(frame[1] + along * frame[3] + right))
            if inside or (0 <= row < heights.shape[0] and 0 <= column < heights.shape[1]):
                between[line, place], whose[line, place] = heights[row, column], owner[row, column]
            else:
                between[line, place], whose[line, place] = 0.0, -1


@compiled
def _tops(between: Heights, whose: IntArray, target: int, least: float) -> tuple[float, float]:
    """Return the greatest height (m) of a target and of all else, ``least`` where none is above it."""
    top, others = least, least
    for line in range(between.shape[0]):
        for place in range(between.shape[1]):
            height = between[line, place]
            if height > least:
                if whose[line, place] == target:
                    top = max(top, height)
                else:
                    others = max(others, height)
    return top, others


@compiled
def _judge(
    heights: Heights, between: Heights, frame: Frame, size: FloatArray, tip: float
) -> tuple[float, float]:
    """Return where along the opening the target's middle is, and the quality of a grasp there, 0 for none.

    :param between: heights between the open fingers, where above the tips there is the target alone
    """
    count, reach, filled = between.shape[0], between.shape[1] // 2, 0
    low, high, inmost_low, inmost_high = reach + 1, -reach - 1, -reach - 1, reach + 1
    left, right = 0.0, 0.0  # heights above the tips where the lines begin and end, added up
    for line in range(count):
        first, last = _ends(between[line], tip + OVERLAP)
        if first < 0:
            continue
        filled += 1
        low, inmost_low = min(low, first - reach), max(inmost_low, first - reach)
        high, inmost_high = max(high, last - reach), min(inmost_high, last - reach)
        left += between[line, first] - tip
        right += between[line, last] - tip
    if filled < FRAGMENT * count:
        return 0.0, 0.0
    skew = (inmost_low - low + high - inmost_high) / (2.0 * filled)
    edge, middle = min(left / filled, right / filled), 0.5 * (low + high)
    if high - low + 1.0 + 2.0 * size[3] > 2.0 * size[0] or skew > SKEW or edge < EDGE:
        return 0.0, 0.0
    if not _fingers_pass(heights, frame, middle, size, tip - BELOW):
        return 0.0, 0.0
    return middle, WORTH - WORTH_SKEW * skew + WORTH_EDGE * min(edge, TALL) + WORTH_WIDTH * filled / count


@compiled
def _ends(line: Heights, least: float) -> tuple[int, int]:
    """Return the first and the last place of a line above a height (m), (-1, -1) where there is none."""
    first, last = 0, len(line) - 1
    while first <= last and line[first] <= least:
        first += 1
    if first > last:
        return -1, -1
    while line[last] <= least:
        last -= 1
    return first, last


@compiled
def _fingers_pass(heights: Heights, frame: Frame, middle: float, size: FloatArray, room: float) -> bool:
    """Whether nothing reaches above a height where the fingers come down on both sides of a middle."""
    lines = int(size[2]) + 2
    for step in range(int(np.ceil(size[1] + 2.0 * size[3])) + 1):
        for across in range(-lines, lines + 1):
            for side in (-1.0, 1.0):
                row, column = _pixel(heights, frame, middle + side * (size[0] - size[3] + step), across)
                if row < 0 or heights[row, column] > room:
                    return False
    return True
