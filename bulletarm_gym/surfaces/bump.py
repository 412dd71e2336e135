"""Bumpy ground of nine pyramids (paper, Open-Loop 6DoF Environments)."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, Pose, Vector, matrix
from bulletarm_gym.objects.solids import block, loft
from bulletarm_gym.simulation import BodySpec, Piece, World
from bulletarm_gym.surfaces.surface import FLOOR, SITE, UP, Point, Surface

SLOPE = math.pi / 12.0
"""Largest slope (rad) of a pyramid's sides (paper, Open-Loop 6DoF Environments)."""
SIDE = 3
"""Pyramids a side of the grid (paper, Open-Loop 6DoF Environments: nine)."""
SLOPES = 30
"""Number of loaded pyramids, of evenly spaced slopes up to :data:`SLOPE`, of which nine are sampled."""
PLATFORM = 0.13
"""Smallest side (m) of the platform."""
FRICTION = 100.0
"""Friction coefficient that keeps objects from sliding into the valleys."""


def pyramid(name: str, side: float, slope: float) -> BodySpec:
    """Return a square pyramid with its axis along z, its frame on the ground."""
    height = math.tan(slope) * side / 2.0
    # The lowest ring gives flat pyramids a volume. The last ring of a loft must not be a point.
    rings = [(side / 2.0, -0.01), (side / 2.0, 0.0), (5e-7, height)]
    corners = [[(-h, -h, z), (h, -h, z), (h, h, z), (-h, h, z)] for h, z in rings]
    return BodySpec(name, (Piece(loft(corners)),), 0.0, FRICTION, colour=(0.74, 0.74, 0.76, 1.0))


class BumpSurface(Surface):
    """Grid of pyramids, rotated about the workspace's centre, and a platform for structures.

    Randomisation: the grid's yaw, the pyramid in each cell, the platform's position and yaw. The platform is
    as high as the highest possible pyramid.
    """

    keeps_poses = False
    sloping = True
    words = "on the bumpy ground"
    slide = 0.01

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        super().__init__(workspace, site)
        self.pitch = (workspace[0][1] - workspace[0][0]) / 2.0
        self.platform_size = (max(PLATFORM, site[0]), max(PLATFORM, site[1]))
        # An open finger fits next to the usual platform. A wider one leaves no space for fingers.
        self._clearance = 0.002 if max(self.platform_size) > PLATFORM else 0.04

    def load(self, world: World) -> None:
        self._world = world
        self.bodies.append(world.add_plane(FLOOR))
        slopes = SLOPE * (np.arange(SLOPES) + 1.0) / SLOPES
        self._slopes = np.tan(slopes)
        self._pyramids = [
            world.add(pyramid(f"pyramid {number}", self.pitch, slope))
            for number, slope in enumerate(slopes.tolist())
        ]
        piece = block((*self.platform_size, self.level), (0.0, 0.0, -self.level / 2.0))
        self._platform = world.add(BodySpec("platform", (piece,), 0.0, colour=(0.86, 0.86, 0.87, 1.0)))
        self.bodies += [*self._pyramids, self._platform]

    def arrange(self, rng: np.random.Generator) -> None:
        grid = Pose.planar(*self.centre, 0.0, float(rng.uniform(0.0, 2.0 * math.pi)))
        for body in self._pyramids:
            self._world.park(body)
        steps = (self.pitch * (np.arange(SIDE) - (SIDE - 1) / 2.0)).tolist()
        cells = [(x, y) for x in steps for y in steps]
        numbers = rng.choice(SLOPES, len(cells), replace=False).tolist()
        for number, (x, y) in zip(numbers, cells, strict=True):
            self._world.place(self._pyramids[number], grid.compose(Pose((x, y, 0.0))))
        point = self._uniform_position(rng, math.hypot(*self.platform_size) / 2.0)
        yaw = float(rng.uniform(-math.pi, math.pi))
        self._world.place(self._platform, Pose.planar(*point, self.level, yaw))

    @property
    def level(self) -> float:
        """Height (m) of the platform."""
        return math.tan(SLOPE) * self.pitch / 2.0

    @property
    def platform(self) -> Pose:
        """Frame at the centre of the platform's upper side."""
        return self._world.poses[self._platform.index]

    @property
    def _numbers(self) -> list[int]:
        return [n for n, body in enumerate(self._pyramids) if self._world.active[body.index]]

    def _local(self, points: ArrayLike) -> FloatArray:
        """Return points (n, 2) in the frames of the nine pyramids, (9, n, 2) m."""
        poses = [self._world.poses[self._pyramids[number].index] for number in self._numbers]
        origins = np.array([pose.position[:2] for pose in poses])
        offsets = np.asarray(points, dtype=np.float64)[None] - origins[:, None]
        local: FloatArray = offsets @ matrix(poses[0])[:2, :2]
        return local

    def _bumps(self, distances: FloatArray) -> FloatArray:
        """Return the heights (m), (9, n), of the pyramids at ``distances`` (9, n) from their axes."""
        rise: FloatArray = self._slopes[self._numbers][:, None] * (self.pitch / 2.0 - distances)
        return np.maximum(rise, 0.0)

    def _on_platform(self, points: ArrayLike) -> FloatArray:
        """Return the distances (m) of points (n, 2) inside the platform's border; negative outside."""
        pose = self.platform
        local = (np.asarray(points, dtype=np.float64) - pose.position[:2]) @ matrix(pose)[:2, :2]
        within: FloatArray = (np.array(self.platform_size) / 2.0 - np.abs(local)).min(axis=1)
        return within

    def _gap(self, footprint: Footprint) -> float:
        return footprint.gap(Footprint.rectangle(self.platform_size, self.platform))

    def heights(self, points: ArrayLike) -> FloatArray:
        bumps = self._bumps(np.abs(self._local(points)).max(axis=2)).max(axis=0)
        return np.where(self._on_platform(points) >= 0.0, self.level, bumps)

    def normal(self, xy: Point) -> Vector:
        local = self._local([xy])[:, 0]
        bumps = self._bumps(np.abs(local).max(axis=1)[:, None])[:, 0]
        highest = int(bumps.argmax())
        if bumps[highest] == 0.0 or self._on_platform([xy])[0] >= 0.0:
            return UP
        number = self._numbers[highest]
        axis = int(np.abs(local[highest]).argmax())
        gradient = np.zeros(2)
        gradient[axis] = math.copysign(float(self._slopes[number]), local[highest, axis])
        pose = self._world.poses[self._pyramids[number].index]
        x, y = (matrix(pose)[:2, :2] @ gradient).tolist()
        length = math.sqrt(x * x + y * y + 1.0)
        return (x / length, y / length, 1.0 / length)

    def _highest(self, footprint: Footprint) -> float:
        """Return an upper bound of the heights (m) below a footprint."""
        if self._gap(footprint) < 0.0:
            return self.level
        local = self._local(footprint.points)
        beside = np.maximum(np.maximum(local.min(axis=1), -local.max(axis=1)), 0.0)
        return float(self._bumps(beside.max(axis=1)[:, None]).max())

    def lay(self, body: BodySpec, xy: Point, yaw: float) -> Pose:
        """Return an upright pose above the highest ground below the body, from which it comes to rest."""
        low = float(body.mesh.bounds[0, 2])
        footprint = Footprint.of(body.mesh.vertices, Pose.planar(*xy, 0.0, yaw))
        return Pose.planar(*xy, self._highest(footprint) - low, yaw)

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        return super().fits(footprint, margin) and self._gap(footprint) >= self._clearance

    def fits_site(self, footprint: Footprint) -> bool:
        return bool(self._on_platform(footprint.points).min() >= -1e-9)

    def _sites(self, size: Point, rng: np.random.Generator, max_yaw: float) -> Iterator[Pose]:
        x, y = ((a - b) / 2.0 for a, b in zip(self.platform_size, size, strict=True))
        if x >= 0.0 and y >= 0.0:
            offset = Pose((float(rng.uniform(-x, x)), float(rng.uniform(-y, y)), 0.0))
            yield self.platform.compose(offset)

    def _is_clear(self, point: Point, distance: float) -> bool:
        return bool(self._on_platform([point])[0] <= -distance)
