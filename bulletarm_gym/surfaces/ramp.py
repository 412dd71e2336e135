"""Two ramps on both sides of a level strip (paper, Open-Loop 6DoF Environments)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, Pose, Vector, matrix
from bulletarm_gym.objects.solids import block
from bulletarm_gym.simulation import BodySpec, World
from bulletarm_gym.surfaces.surface import ATTEMPTS, FLOOR, UP, Point, Surface

STRIP_WIDTHS = (0.04, 0.2)
"""Range of the strip's width (m; paper, Open-Loop 6DoF Environments)."""
SLOPE = math.pi / 6.0
"""Largest slope of a ramp (rad; paper, Open-Loop 6DoF Environments)."""
EDGE_HEIGHT = 0.01
"""Largest height (m) of a ramp's lower edge (paper, Open-Loop 6DoF Environments)."""
NEAREST_EDGE, FARTHEST_EDGE = STRIP_WIDTHS[0] / 2.0, STRIP_WIDTHS[1] / 2.0
"""Range of the distance (m) of an edge from the workspace's centre, which is in the strip."""
THICKNESS = 0.01
"""Thickness (m) of a plate."""
PLATE_OVERHANG = 0.005
"""Length (m) by which plates exceed the workspace."""
WIDTHS = 4
"""Number of plates of different widths; the narrowest that covers the workspace is clear of the arm."""
STEPS = 4
"""Number of steps in which a plate becomes shorter."""


def plate(name: str, length: float, width: float) -> BodySpec:
    """Return a plate that rises along y; the x axis of its frame is the lower edge of its upper side.

    It becomes shorter in steps towards its upper side, where corners outside the workspace would touch the
    arm.
    """
    corner = (2.0 - math.sqrt(2.0)) * length / 2.0  # outside the inscribed circle
    cut = min(corner, width) / STEPS  # in a small workspace a plate is shorter than its corner
    depths = [width - (STEPS - 1) * cut, *[cut] * (STEPS - 1)]
    rows = []
    for step, depth in enumerate(depths):
        middle = sum(depths[:step]) + depth / 2.0
        rows.append(block((length - 2.0 * cut * step, depth, THICKNESS), (0.0, middle, -THICKNESS / 2.0)))
    return BodySpec(name, tuple(rows), 0.0, colour=(0.82, 0.68, 0.47, 1.0))


@dataclass(frozen=True)
class Ramp:
    """Plane of a plate's upper side.

    :param edge: world x, y, z (m) of a point on the lower edge
    :param uphill: unit vector, world x and y
    :param slope: rad
    """

    edge: Vector
    uphill: Point
    slope: float

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, pose: Pose) -> "Ramp":
        """Return the ramp of a plate at a pose."""
        axes = matrix(pose)
        return cls(pose.position, (-float(axes[1, 0]), float(axes[0, 0])), pose.tilt)

    @property
    def normal(self) -> Vector:
        across = -math.sin(self.slope)
        return (across * self.uphill[0], across * self.uphill[1], math.cos(self.slope))

    def distances(self, points: ArrayLike) -> FloatArray:
        """Return the horizontal distances (m) of points (n, 2) beyond the lower edge, negative before it."""
        beyond: FloatArray = (np.asarray(points, dtype=np.float64) - self.edge[:2]) @ self.uphill
        return beyond


class RampSurface(Surface):
    """Two plates with parallel edges, and a level strip for structures between them.

    Randomisation: the width of the strip, its direction and position, the slope of each plate and the height
    of its edge. The strip is at least as wide as the task's structure.
    """

    words = "on the ground with ramps"
    sloping = True

    def load(self, world: World) -> None:
        self._world = world
        self._half_diagonal = (self.workspace[0][1] - self.workspace[0][0]) / math.sqrt(2.0)
        widest = (self._half_diagonal - NEAREST_EDGE) / math.cos(SLOPE) + PLATE_OVERHANG
        self._widths = np.linspace(max(self._half_diagonal - FARTHEST_EDGE, 0.0), widest, WIDTHS + 1)[1:]
        length = 2.0 * (self._half_diagonal + PLATE_OVERHANG)
        self.bodies.append(world.add_plane(FLOOR))
        self._plates = [
            [world.add(plate(f"{name} ramp {width:.3f}", length, width)) for width in self._widths.tolist()]
            for name in ("first", "second")
        ]
        self.bodies += [*self._plates[0], *self._plates[1]]

    def arrange(self, rng: np.random.Generator) -> None:
        yaw = rng.uniform(0.0, 2.0 * math.pi)
        gap = rng.uniform(min(max(STRIP_WIDTHS[0], self.site[0]), STRIP_WIDTHS[1]), STRIP_WIDTHS[1])
        nearest = max(NEAREST_EDGE, gap - FARTHEST_EDGE)
        first = rng.uniform(nearest, gap - nearest)
        sides = ((first, yaw), (gap - first, yaw + math.pi))
        for plates, (distance, yaw) in zip(self._plates, sides, strict=True):
            slope = rng.uniform(0.0, SLOPE)
            x, y = self.centre[0] - distance * math.sin(yaw), self.centre[1] + distance * math.cos(yaw)
            edge = Pose.planar(x, y, float(rng.uniform(0.0, EDGE_HEIGHT)), yaw)
            tilt = Pose((0.0, 0.0, 0.0), (math.sin(slope / 2.0), 0.0, 0.0, math.cos(slope / 2.0)))
            wide_enough = self._widths * math.cos(slope) + distance >= self._half_diagonal
            for body in plates:
                self._world.park(body)
            self._world.place(plates[int(wide_enough.argmax())], edge.compose(tilt))

    @property
    def ramps(self) -> tuple[Ramp, Ramp]:
        """Both ramps at present."""
        world = self._world
        first, second = (
            Ramp.of(next(world.poses[body.index] for body in plates if world.active[body.index]))
            for plates in self._plates
        )
        return first, second

    @property
    def gap(self) -> float:
        """Width (m) of the level strip."""
        first, second = self.ramps
        return -float(first.distances([second.edge[:2]])[0])

    def heights(self, points: ArrayLike) -> FloatArray:
        found = np.zeros(len(np.asarray(points)))
        for ramp in self.ramps:
            beyond = ramp.distances(points)
            found = np.where(beyond >= 0.0, ramp.edge[2] + math.tan(ramp.slope) * beyond, found)
        return found

    def normal(self, xy: Point) -> Vector:
        return next((ramp.normal for ramp in self.ramps if ramp.distances([xy])[0] >= 0.0), UP)

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        beyond = [ramp.distances(footprint.points) for ramp in self.ramps]
        crosses = any(values.min() < 0.0 < values.max() for values in beyond)
        return not crosses and super().fits(footprint, margin)

    def fits_site(self, footprint: Footprint) -> bool:
        between = all(ramp.distances(footprint.points).max() <= 0.0 for ramp in self.ramps)
        return between and super().fits(footprint)

    def _sites(self, size: Point, rng: np.random.Generator, max_yaw: float) -> Iterator[Pose]:
        first, second = self.ramps
        room, half = (self.gap - size[0]) / 2.0, self._half_diagonal
        middle = np.add(first.edge[:2], second.edge[:2]) / 2.0
        yaw = math.atan2(first.uphill[1], first.uphill[0])
        for _ in range(ATTEMPTS if room >= 0.0 else 0):
            x, y = middle + rng.uniform(-room, room) * np.array(first.uphill)
            along = Pose((0.0, float(rng.uniform(-half, half)), 0.0))
            yield Pose.planar(x, y, self.level, yaw).compose(along)

    def _is_clear(self, point: Point, distance: float) -> bool:
        return all(abs(ramp.distances([point])[0]) >= distance for ramp in self.ramps)
