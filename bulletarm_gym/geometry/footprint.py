"""Footprints of bodies on the ground, and the gaps between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bulletarm_gym.geometry.poses import FloatArray, Pose, matrix

DIRECTIONS = 32
"""Number of evenly spaced directions, from x, in which footprints are compared."""
_ANGLES = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
_COMPASS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_OPPOSITE = np.roll(np.arange(DIRECTIONS), DIRECTIONS // 2)


class PlacementError(RuntimeError):
    """Raised when no arrangement of the objects fits into the workspace."""


@dataclass(frozen=True)
class Footprint:
    """Vertical projection of a body onto the ground: the convex hull of some points.

    :param points: (n, 2) world x and y (m)
    """

    points: FloatArray

    @classmethod
    def of(cls, vertices: FloatArray, pose: Pose) -> "Footprint":
        """Return the footprint of a body at a pose.

        :param vertices: (n, 3) vertices in the body's frame (m)
        """
        return cls(vertices @ matrix(pose)[:2].T + pose.position[:2])

    @classmethod
    def rectangle(cls, size: Sequence[float], pose: Pose) -> "Footprint":
        """Return a rectangle of side lengths ``size`` (m) along x and y of a frame, centred on its origin."""
        x, y = float(size[0]) / 2.0, float(size[1]) / 2.0
        return cls.of(np.array(((-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0))), pose)

    @property
    def centre(self) -> FloatArray:
        """Centre (2,) m of the bounding box along x and y."""
        centre: FloatArray = (self.points.min(axis=0) + self.points.max(axis=0)) / 2.0
        return centre

    def grown(self, margin: float) -> "Footprint":
        """Return the footprint with its points moved outwards by ``margin`` (m); it may be negative."""
        offsets = self.points - self.points.mean(axis=0)
        lengths = np.sqrt((offsets**2).sum(axis=1, keepdims=True))
        return Footprint(self.points + offsets / np.maximum(lengths, 1e-9) * margin)

    @cached_property
    def reach(self) -> FloatArray:
        """Extent (m) from the world's origin in :data:`DIRECTIONS` directions, -inf without points."""
        reach: FloatArray = (self.points @ _COMPASS).max(axis=0, initial=-np.inf)
        return reach

    @property
    def width(self) -> float:
        """Minimum distance (m) between two parallel fingers around the body, over the compared directions.

        The value exceeds the true minimum by at most 0.5 % of the size.
        """
        return float((self.reach + self.reach[_OPPOSITE]).min())

    def gap(self, *others: "Footprint") -> float:
        """Return a lower bound of the distance (m) to the nearest of some footprints, infinite without one.

        It is negative where they may overlap.
        """
        opposite = self.reach[_OPPOSITE]
        return -max((float((opposite + other.reach).min()) for other in others), default=-np.inf)

    def is_inside(self, limits: Sequence[Sequence[float]], margin: float = 0.0) -> bool:
        """Return True if the footprint keeps a margin (m) to limits [[x low, x high], [y low, y high]]."""
        low, high = np.array(limits[:2]).T
        is_above = (low <= self.points.min(axis=0) - margin).all()
        return bool(is_above and (self.points.max(axis=0) + margin <= high).all())
