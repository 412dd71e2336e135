"""What things cover of the ground, and whether two of them are apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose, matrix

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
        return cls(vertices @ matrix(pose)[:2].T + pose.position[:2])

    @classmethod
    def rectangle(cls, size: Sequence[float], pose: Pose) -> "Footprint":
        """Return a level rectangle of side lengths ``size`` (m) along x and y of a frame, in its middle."""
        x, y = size[0] / 2.0, size[1] / 2.0
        return cls.of(np.array([(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)]), pose)

    @property
    def centre(self) -> tuple[float, float]:
        """Middle (m) of the corners' extent along x and y."""
        x, y = ((self.points.min(axis=0) + self.points.max(axis=0)) / 2.0).tolist()
        return (x, y)

    def grown(self, margin: float) -> "Footprint":
        """Return it with its corners moved outwards by ``margin`` (m), or inwards by a negative one."""
        outwards = self.points - self.points.mean(axis=0)
        lengths = np.linalg.norm(outwards, axis=1, keepdims=True)
        return Footprint(self.points + outwards / np.maximum(lengths, 1e-9) * margin)

    @cached_property
    def reach(self) -> FloatArray:
        """How far (m) it reaches in each of the directions, from the world's origin."""
        reach: FloatArray = (self.points @ _COMPASS).max(axis=0)
        return reach

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
        return float(-(self.reach + other.reach[_OPPOSITE]).min())

    def is_inside(self, limits: Sequence[Sequence[float]], margin: float = 0.0) -> bool:
        """Whether it keeps a margin (m) to the border of [[x low, x high], [y low, y high]]."""
        low, high = self.points.min(axis=0) - margin, self.points.max(axis=0) + margin
        return all(limits[axis][0] <= low[axis] and high[axis] <= limits[axis][1] for axis in (0, 1))
