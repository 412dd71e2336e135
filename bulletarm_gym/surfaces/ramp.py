"""Two ramps that rise on both sides of a level strip (paper, Open-Loop 6DoF Environments)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose, Vector, matrix
from bulletarm_gym.objects.solids import block
from bulletarm_gym.simulation import BodySpec, World
from bulletarm_gym.surfaces.flat import FLOOR
from bulletarm_gym.surfaces.surface import ATTEMPTS, COVERED_SHARE, UP, Point, Surface

STRIP_WIDTHS = (0.04, 0.2)
"""Between the ramps (m; paper, Open-Loop 6DoF Environments)."""
SLOPE = math.pi / 6.0
"""Greatest slope of a ramp (rad; paper, Open-Loop 6DoF Environments)."""
EDGE_HEIGHT = 0.01
"""Greatest height (m) of a ramp's lower edge above the ground (paper, Open-Loop 6DoF Environments)."""
NEAREST_EDGE = STRIP_WIDTHS[0] / 2.0
FARTHEST_EDGE = STRIP_WIDTHS[1] / 2.0
"""Least and greatest distance (m) of an edge from the workspace's middle: the strip crosses the middle."""
THICKNESS = 0.01
"""Of a plate (m)."""
PLATE_OVERHANG = 0.005
"""What plates are longer (m) than the workspace needs."""
WIDTHS = 4
"""Plates there are of different widths: the narrowest that covers the workspace keeps clear of the arm."""
CUT = 2.0 - math.sqrt(2.0)
"""What a square's corners have outside its inscribed circle along its sides, in halves of a side."""
STEPS = 4
"""In which a plate becomes shorter."""
COLOUR = (0.82, 0.68, 0.47, 1.0)


def plate(name: str, length: float, width: float) -> BodySpec:
    """Return a plate that rises along y; x of its frame runs along the lower edge of its upper side.

    It becomes shorter in steps towards its upper side: corners outside the workspace would reach the arm.
    """
    cut = CUT * length / 2.0 / STEPS
    depths = [width - (STEPS - 1) * cut, *[cut] * (STEPS - 1)]
    rows = []
    for step, depth in enumerate(depths):
        middle = sum(depths[:step]) + depth / 2.0
        rows.append(block((length - 2.0 * cut * step, depth, THICKNESS), (0.0, middle, -THICKNESS / 2.0)))
    return BodySpec(name, tuple(rows), 0.0, colour=COLOUR)


@dataclass(frozen=True)
class Ramp:
    """The plane of a plate's upper side.

    :param edge: world x, y, z (m) of a point on the lower edge
    :param uphill: unit vector, world x and y
    :param slope: rad
    """

    edge: Vector
    uphill: Point
    slope: float

    @classmethod
    def of(cls, pose: Pose) -> "Ramp":
        """Return the ramp of a plate at a pose."""
        axes = matrix(pose)
        return cls(pose.position, (-float(axes[1, 0]), float(axes[0, 0])), pose.tilt)

    @property
    def normal(self) -> Vector:
        """The unit normal."""
        across = -math.sin(self.slope)
        return (across * self.uphill[0], across * self.uphill[1], math.cos(self.slope))

    def distances(self, points: ArrayLike) -> FloatArray:
        """Return how far (m), seen from above, points (n, 2) are beyond the lower edge, negative before."""
        beyond: FloatArray = (np.asarray(points, dtype=np.float64) - self.edge[:2]) @ self.uphill
        return beyond


_ramp = lru_cache(maxsize=16)(Ramp.of)
"""They lie as they lie for a whole episode."""


class RampSurface(Surface):
    """Two plates with parallel edges; between them a level strip where structures stand.

    Randomisation: the width of the strip, its direction and where it crosses the workspace, each plate's
    slope and the height of its edge. The strip is at least as wide as what the task builds.
    """

    sloping = True

    def load(self, world: World) -> None:
        """Load the ground and the plates, which cover the workspace wherever they are put."""
        self._world = world
        self.bodies.append(world.add_plane(FLOOR))
        widest = (self._half_diagonal - NEAREST_EDGE) / math.cos(SLOPE) + PLATE_OVERHANG
        self._widths = np.linspace(self._half_diagonal - FARTHEST_EDGE, widest, WIDTHS + 1)[1:]
        length = 2.0 * (self._half_diagonal + PLATE_OVERHANG)
        self._plates = [
            [world.add(plate(f"{name} ramp {width:.3f}", length, width)) for width in self._widths.tolist()]
            for name in ("first", "second")
        ]
        self.bodies += [*self._plates[0], *self._plates[1]]

    def arrange(self, rng: np.random.Generator) -> None:
        """Draw the strip and both plates."""
        turn = rng.uniform(0.0, 2.0 * math.pi)
        gap = rng.uniform(min(max(STRIP_WIDTHS[0], self.site[0]), STRIP_WIDTHS[1]), STRIP_WIDTHS[1])
        nearest = max(NEAREST_EDGE, gap - FARTHEST_EDGE)
        first = rng.uniform(nearest, gap - nearest)
        sides = ((first, turn), (gap - first, turn + math.pi))
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
    def _half_diagonal(self) -> float:
        return (self.workspace[0][1] - self.workspace[0][0]) / math.sqrt(2.0)

    @property
    def ramps(self) -> tuple[Ramp, Ramp]:
        """Both ramps as they lie."""
        world = self._world
        first, second = (
            _ramp(next(world.poses[body.index] for body in plates if world.active[body.index]))
            for plates in self._plates
        )
        return first, second

    @property
    def gap(self) -> float:
        """Width (m) of the level strip."""
        first, second = self.ramps
        return -float(first.distances([second.edge[:2]])[0])

    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the heights of the plates, and 0 between them."""
        found = np.zeros(len(np.asarray(points)))
        for ramp in self.ramps:
            beyond = ramp.distances(points)
            found = np.where(beyond >= 0.0, ramp.edge[2] + math.tan(ramp.slope) * beyond, found)
        return found

    def normal(self, xy: Point) -> Vector:
        """Return the normal of the plate there, or the vertical between the plates."""
        under = (ramp.normal for ramp in self.ramps if ramp.distances([xy])[0] >= 0.0)
        return next(under, UP)

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Whether a footprint is inside the workspace and crosses no edge."""
        beyond = [ramp.distances(footprint.points) for ramp in self.ramps]
        crosses = any(values.min() < 0.0 < values.max() for values in beyond)
        return not crosses and super().fits(footprint, margin)

    def fits_site(self, footprint: Footprint) -> bool:
        """Whether a footprint is inside the workspace and between the plates."""
        between = all(ramp.distances(footprint.points).max() <= 0.0 for ramp in self.ramps)
        return between and super().fits(footprint)

    def _sites(self, size: Point, rng: np.random.Generator, spread: float) -> Iterator[Pose]:
        """Draw frames in the strip whose y axis runs along it."""
        first, second = self.ramps
        room = (self.gap - size[0]) / 2.0
        middle = np.add(first.edge[:2], second.edge[:2]) / 2.0
        yaw = math.atan2(first.uphill[1], first.uphill[0])
        half = self._half_diagonal
        for _ in range(ATTEMPTS if room >= 0.0 else 0):
            x, y = middle + rng.uniform(-room, room) * np.array(first.uphill)
            yield Pose.planar(x, y, self.level, yaw).compose(
                Pose((0.0, float(rng.uniform(-half, half)), 0.0))
            )

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Draw a point at least ``margin`` (m) from the border, clear of the plates' edges.

        :raises PlacementError: the workspace is narrower than twice the margin
        :raises PlacementError: the plates leave no such point
        """
        for _ in range(ATTEMPTS):
            point = super().sample_position(rng, margin)
            if all(abs(ramp.distances([point])[0]) >= COVERED_SHARE * margin for ramp in self.ramps):
                return point
        raise PlacementError(f"workspace: the ramps leave no room for a margin of {margin:.3f} m")
