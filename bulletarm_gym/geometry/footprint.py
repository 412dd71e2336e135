"""What things cover of the ground, and whether two of them are apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bulletarm_gym.geometry.compilation import compiled, fma
from bulletarm_gym.geometry.poses import FloatArray, Pose, Quaternion

DIRECTIONS = 32
"""Directions in which footprints are compared: with each its opposite, x and y among them."""
_TURNS = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
_COMPASS = np.stack([np.cos(_TURNS), np.sin(_TURNS)])
_OPPOSITE = np.roll(np.arange(DIRECTIONS), DIRECTIONS // 2)


class PlacementError(RuntimeError):
    """No arrangement was found; the workspace is too small for what it should hold."""


@dataclass(frozen=True)
class Footprint:
    """The shadow of something, straight from above: the convex hull of some points.

    :param points: (n, 2) world x and y (m)
    """

    points: FloatArray

    @classmethod
    def of(cls, vertices: FloatArray, pose: Pose) -> "Footprint":
        """Return the footprint of a body at a pose.

        :param vertices: (n, 3) of the body, in its frame (m)
        """
        return cls(_shadow(vertices, pose.x, pose.y, pose.orientation))

    @classmethod
    def rectangle(cls, size: Sequence[float], pose: Pose) -> "Footprint":
        """Return a level rectangle of side lengths ``size`` (m) along x and y of a frame, in its middle."""
        return cls(_corners(float(size[0]), float(size[1]), pose.x, pose.y, pose.orientation))

    @property
    def centre(self) -> tuple[float, float]:
        """Middle (m) of the corners' extent along x and y."""
        x0, x1, y0, y1 = self.extent
        return ((x0 + x1) / 2.0, (y0 + y1) / 2.0)

    @cached_property
    def mean(self) -> tuple[float, float]:
        """Mean x and y (m) of the points."""
        return _mean(self.points)

    @cached_property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x, lowest and highest y (m)."""
        return _extent(self.points)

    def grown(self, margin: float) -> "Footprint":
        """Return it with its corners moved outwards by ``margin`` (m), or inwards by a negative one."""
        return Footprint(_grown(self.points, margin))

    @cached_property
    def reach(self) -> FloatArray:
        """How far (m) it reaches in each of the directions, from the world's origin."""
        return _reach(self.points, _COMPASS)

    @property
    def width(self) -> float:
        """How far apart (m) two parallel fingers must be to go down on both sides of it, turned as they may.

        It exceeds the least such distance by half a percent of its size at most; of a rectangle that lies
        along x and y it is exact.
        """
        return float((self.reach + self.reach[_OPPOSITE]).min())

    def gap(self, other: "Footprint") -> float:
        """Return a distance (m) that two footprints keep at least; negative where they may overlap.

        It falls short of the true distance by at most half a percent of their sizes, and between corners by
        more; it never exceeds it.
        """
        return _gap(self.reach, other.reach)

    def is_inside(self, limits: Sequence[Sequence[float]], margin: float = 0.0) -> bool:
        """Whether it keeps a margin (m) to the border of [[x low, x high], [y low, y high]]."""
        x0, x1, y0, y1 = self.extent
        (left, right), (near, far) = limits[:2]
        return left <= x0 - margin and x1 + margin <= right and near <= y0 - margin and y1 + margin <= far


# Hundreds of footprints are compared for one place to build on, of few points each: NumPy would take ten
# times as long. The compiled code rounds as NumPy does.


@compiled
def _shadow(vertices: FloatArray, x: float, y: float, orientation: Quaternion) -> FloatArray:
    """Return the world x and y of points (n, 3) at a pose."""
    qx, qy, qz, qw = orientation
    xx, xy, xz = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)
    yx, yy, yz = 2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)
    points = np.empty((len(vertices), 2))
    for row in range(len(vertices)):
        a, b, c = vertices[row, 0], vertices[row, 1], vertices[row, 2]
        points[row, 0] = fma(c, xz, fma(b, xy, a * xx)) + x
        points[row, 1] = fma(c, yz, fma(b, yy, a * yx)) + y
    return points


@compiled
def _corners(width: float, length: float, x: float, y: float, orientation: Quaternion) -> FloatArray:
    """Return the corners of a rectangle about the origin of a frame."""
    corners = np.zeros((4, 3))
    for row, (right, far) in enumerate(((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))):
        corners[row, 0], corners[row, 1] = right * (width / 2.0), far * (length / 2.0)
    return _shadow(corners, x, y, orientation)


@compiled
def _mean(points: FloatArray) -> tuple[float, float]:
    x, y = points[0, 0], points[0, 1]
    for row in range(1, len(points)):
        x += points[row, 0]
        y += points[row, 1]
    return x / len(points), y / len(points)


@compiled
def _extent(points: FloatArray) -> tuple[float, float, float, float]:
    return points[:, 0].min(), points[:, 0].max(), points[:, 1].min(), points[:, 1].max()


@compiled
def _grown(points: FloatArray, margin: float) -> FloatArray:
    x, y = _mean(points)
    grown = np.empty_like(points)
    for row in range(len(points)):
        dx, dy = points[row, 0] - x, points[row, 1] - y
        length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        grown[row, 0] = points[row, 0] + dx / length * margin
        grown[row, 1] = points[row, 1] + dy / length * margin
    return grown


@compiled
def _reach(points: FloatArray, compass: FloatArray) -> FloatArray:
    reach = np.full(compass.shape[1], -np.inf)
    for row in range(len(points)):
        for direction in range(len(reach)):
            far = fma(points[row, 1], compass[1, direction], points[row, 0] * compass[0, direction])
            reach[direction] = max(reach[direction], far)
    return reach


@compiled
def _gap(reach: FloatArray, other: FloatArray) -> float:
    half = len(reach) // 2
    least = np.inf
    for direction in range(half):
        least = min(least, reach[direction] + other[direction + half])
        least = min(least, reach[direction + half] + other[direction])
    return -least
