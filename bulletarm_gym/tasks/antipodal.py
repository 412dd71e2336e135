"""Grasps from above on whatever lies there, found in heightmaps: what a clutter's expert plans with.

A parallel gripper comes straight down on a point at some yaw. Its fingers must find room beside the target,
nothing else may be between them, and where they meet the target it must be steep and square to them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.robots.gripper import Gripper

YAWS = 16
"""Directions tried over half a turn."""
DEPTHS = (0.04, 0.025, 0.014)
"""How far (m) below the highest point between the fingers their tips may go: deep grasps hold best."""
SPACING = 4
"""Pixels between the points tried."""
BESIDE = 0.004
"""Gap (m) kept between the fingers' outline and everything they pass on the way down."""
BELOW = 0.002
"""Least gap (m) between the fingertips and what is under them."""
OVERLAP = 0.005
"""A surface this far (m) above the fingertips is between the fingers, not under them."""
SKEW = 0.7
"""Sides of the target may be turned against the fingers by this slope (35 degrees) ..."""
EDGE = 0.007
"""... and must stand this high (m) above the fingertips where they meet the fingers."""


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
        return self.extent / self.ground.shape[0]

    def top_between(self, first: Sequence[float], second: Sequence[float], reach: float) -> float:
        """Return the greatest height (m) of an item in the rectangle between two points, ``reach`` (m) wider."""
        low, high = (
            [self._pixel(choose(a, b) + sign * reach, axis) for axis, (a, b) in enumerate(zip(first[:2], second[:2], strict=True))]
            for choose, sign in ((min, -1.0), (max, 1.0))
        )
        window = self.layers[:, low[0] : high[0] + 1, low[1] : high[1] + 1]
        return float(window.max()) if window.size else 0.0

    def _pixel(self, value: float, axis: int) -> int:
        size = self.ground.shape[0]
        return min(max(int((value - self.centre[axis] + self.extent / 2.0) / self.pitch), 0), size - 1)


def find_grasps(relief: Relief, gripper: Gripper, yaws: Sequence[float], lowest: float) -> FloatArray:
    """Return the grasps that have room, best known by their last column.

    :param yaws: directions (rad) in which the fingers may open
    :param lowest: height (m) below which the fingertips may not go
    :return: (n, 6): x, y, z (m), yaw (rad) of the fingertips, index of the item, quality (m)
    """
    heights = np.maximum(relief.layers.max(axis=0), relief.ground)
    owner = np.where(relief.layers.max(axis=0) >= relief.ground, relief.layers.argmax(axis=0), -1)
    fingers = np.array([gripper.stroke / 2.0, gripper.finger[0], gripper.finger[1] / 2.0]) / relief.pitch
    beside = BESIDE / relief.pitch
    found = _search(
        heights,
        owner.astype(np.int32),
        fingers,
        beside,
        np.asarray(yaws, dtype=np.float64),
        np.array(DEPTHS),
        lowest,
        relief.pitch,
    )
    half = (heights.shape[0] - 1) / 2.0
    found[:, 0] = relief.centre[0] + (found[:, 0] - half) * relief.pitch
    found[:, 1] = relief.centre[1] + (found[:, 1] - half) * relief.pitch
    return found


@njit(cache=True)
def _search(heights, owner, fingers, beside, yaws, depths, lowest, pitch):  # type: ignore[no-untyped-def]
    """Try every SPACING-th pixel of every item at every yaw and depth."""
    size = heights.shape[0]
    found = np.empty((0, 6))
    rows = []
    for i in range(SPACING // 2, size, SPACING):
        for j in range(SPACING // 2, size, SPACING):
            if owner[i, j] < 0:
                continue
            for yaw in yaws:
                for depth in depths:
                    row = _try(heights, owner, i, j, yaw, depth, fingers, beside, lowest, pitch)
                    if row[5] > 0.0:
                        rows.append(row)
    if len(rows) > 0:
        found = np.empty((len(rows), 6))
        for index in range(len(rows)):
            found[index] = rows[index]
    return found


@njit(cache=True)
def _at(heights, u, v):  # type: ignore[no-untyped-def]
    size = heights.shape[0]
    i, j = int(np.rint(u)), int(np.rint(v))
    if i < 0 or j < 0 or i >= size or j >= size:
        return 1.0, -1, -1
    return heights[i, j], i, j


@njit(cache=True)
def _try(heights, owner, i, j, yaw, depth, fingers, beside, lowest, pitch):  # type: ignore[no-untyped-def]
    """Return x, y (pixels), z, yaw, item, quality of a grasp about a pixel; quality 0 where there is none."""
    target = owner[i, j]
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    cos, sin = math.cos(yaw), math.sin(yaw)
    inner, thick, half_width = fingers
    lines = int(half_width) + 1
    reach = int(inner)
    # What of the target is between the fingers, and how high.
    top = 0.0
    for line in range(-lines, lines + 1):
        for along in range(-reach, reach + 1):
            height, a, b = _at(heights, i + along * cos - line * sin, j + along * sin + line * cos)
            if a >= 0 and owner[a, b] == target and height > top:
                top = height
    tip = max(lowest, top - depth)
    if top - tip < OVERLAP:
        return nothing
    low, high = reach + 1, -reach - 1
    low_spread, high_spread, filled = 0.0, 0.0, 0
    low_edge, high_edge = 0.0, 0.0
    lows = np.zeros(2 * lines + 1)
    highs = np.zeros(2 * lines + 1)
    for line in range(-lines, lines + 1):
        first, last = reach + 1, -reach - 1
        for along in range(-reach, reach + 1):
            height, a, b = _at(heights, i + along * cos - line * sin, j + along * sin + line * cos)
            if height > tip + OVERLAP:
                if a < 0 or owner[a, b] != target:
                    return nothing
                if first > reach:
                    first = along
                    low_edge += height - tip
                last = along
                high_height = height
        if last >= first:
            lows[filled], highs[filled] = first, last
            high_edge += high_height - tip
            filled += 1
            low, high = min(low, first), max(high, last)
    if filled < lines:
        return nothing
    middle = 0.5 * (low + high)
    width = high - low + 1.0
    if width + 2.0 * beside > 2.0 * inner:
        return nothing
    low_spread = lows[:filled].max() - lows[:filled].min()
    high_spread = highs[:filled].max() - highs[:filled].min()
    u, v = i + middle * cos, j + middle * sin
    # Room for the fingers beside it.
    room = tip - BELOW
    spare = beside
    for side in (-1.0, 1.0):
        steps = int(np.ceil(thick + 2.0 * beside)) + 1
        for step in range(steps):
            along = side * (inner - spare + step)
            for line in range(-lines - 1, lines + 2):
                height, a, b = _at(heights, u + along * cos - line * sin, v + along * sin + line * cos)
                if height > room:
                    return nothing
    # Edges square to the fingers, and steep where they touch; quality in metres.
    skew = (low_spread + high_spread) / (2.0 * filled)
    steep = min(low_edge, high_edge) / filled
    if skew > SKEW or steep < EDGE:
        return nothing
    quality = 0.3 - 0.12 * skew + 1.5 * min(steep, 0.03) + 0.02 * filled / (2 * lines + 1)
    return u, v, tip, yaw, float(target), quality
