"""Bumpy ground: nine pyramids side by side (paper, Open-Loop 6DoF Environments)."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose, Vector, matrix
from bulletarm_gym.objects.solids import loft
from bulletarm_gym.simulation import BodySpec, Box, Piece, World
from bulletarm_gym.surfaces.flat import FLOOR
from bulletarm_gym.surfaces.surface import ATTEMPTS, COVERED_SHARE, SITE, UP, Point, Surface

SLOPE = math.pi / 12.0
"""Greatest slope (rad) of a pyramid's sides (paper, Open-Loop 6DoF Environments)."""
SIDE = 3
"""Pyramids a side of the grid (paper, Open-Loop 6DoF Environments: nine)."""
SLOPES = 30
"""Steepnesses there are, evenly spaced up to :data:`SLOPE`, one pyramid of each: nine of them are drawn."""
PLATFORM = 0.13
"""Least side (m) of the platform."""
FRICTION = 100.0
"""So that nothing slides into the valleys."""
DEPTH = 0.01
"""How far (m) pyramids continue below the ground: hulls need a volume."""
PEAK = 1e-6
"""Side (m) of the square that a pyramid is cut at: a loft's last ring must not be a point."""
PLATFORM_CLEARANCE = 0.04
"""Gap (m) between things put on the ground and the platform: an open finger comes down in it ..."""
LEAST_PLATFORM_CLEARANCE = 0.002
"""... which a platform wider than :data:`PLATFORM` leaves no space for."""
LIGHT = (0.86, 0.86, 0.87, 1.0)
GREY = (0.74, 0.74, 0.76, 1.0)


def pyramid(name: str, side: float, slope: float) -> BodySpec:
    """Return a square pyramid with its axis along z, its frame on the ground."""
    height = math.tan(slope) * side / 2.0
    rings = [(side, -DEPTH), (side, 0.0), (PEAK, height)]
    corners = [
        [(-s / 2.0, -s / 2.0, z), (s / 2.0, -s / 2.0, z), (s / 2.0, s / 2.0, z), (-s / 2.0, s / 2.0, z)]
        for s, z in rings
    ]
    return BodySpec(name, (Piece(loft(corners)),), 0.0, FRICTION, colour=GREY)


class BumpSurface(Surface):
    """A grid of pyramids, turned about the workspace's middle, and a platform for what is to be built.

    Randomisation: the grid's yaw, which pyramid stands where, the platform's position and yaw. The platform
    is as high as the highest pyramid can be.
    """

    keeps_poses = False
    sloping = True
    slide = 0.01

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        super().__init__(workspace, site)
        self.pitch = (workspace[0][1] - workspace[0][0]) / 2.0
        self.platform_size = (max(PLATFORM, site[0]), max(PLATFORM, site[1]))
        self._room = PLATFORM_CLEARANCE if max(self.platform_size) <= PLATFORM else LEAST_PLATFORM_CLEARANCE

    def load(self, world: World) -> None:
        """Load the ground, a pyramid of every steepness and the platform."""
        self._world = world
        self.bodies.append(world.add_plane(FLOOR))
        slopes = SLOPE * (np.arange(SLOPES) + 1.0) / SLOPES
        self._slopes = np.tan(slopes)
        self._pyramids = [
            world.add(pyramid(f"pyramid {number}", self.pitch, slope))
            for number, slope in enumerate(slopes.tolist())
        ]
        block = Piece(Box((*self.platform_size, self.level)), Pose((0.0, 0.0, -self.level / 2.0)))
        self._platform = world.add(BodySpec("platform", (block,), 0.0, colour=LIGHT))
        self.bodies += [*self._pyramids, self._platform]

    def arrange(self, rng: np.random.Generator) -> None:
        """Draw the pyramids and the platform."""
        grid = Pose.planar(*self.centre, 0.0, float(rng.uniform(0.0, 2.0 * math.pi)))
        for body in self._pyramids:
            self._world.park(body)
        steps = self.pitch * (np.arange(SIDE) - (SIDE - 1) / 2.0)
        places = [(x, y) for x in steps.tolist() for y in steps.tolist()]
        drawn = rng.choice(SLOPES, len(places), replace=False)
        for number, (x, y) in zip(drawn.tolist(), places, strict=True):
            self._world.place(self._pyramids[number], grid.compose(Pose((x, y, 0.0))))
        margin = math.hypot(*self.platform_size) / 2.0
        point = super().sample_position(rng, margin)
        yaw = float(rng.uniform(-math.pi, math.pi))
        self._world.place(self._platform, Pose.planar(*point, self.level, yaw))

    @property
    def level(self) -> float:
        """Height (m) of the platform."""
        return math.tan(SLOPE) * self.pitch / 2.0

    @property
    def platform(self) -> Pose:
        """Frame of the platform, in the middle of its upper side."""
        return self._world.poses[self._platform.index]

    @property
    def slopes(self) -> FloatArray:
        """Slopes (rad) of the nine pyramids there are."""
        found: FloatArray = np.arctan(self._slopes[self._standing])
        return found

    @property
    def _standing(self) -> list[int]:
        return [n for n, body in enumerate(self._pyramids) if self._world.active[body.index]]

    def _local(self, points: ArrayLike) -> FloatArray:
        """Return points (n, 2) in the frames of the nine pyramids, (9, n, 2) m."""
        poses = [self._world.poses[self._pyramids[number].index] for number in self._standing]
        origins = np.array([pose.position[:2] for pose in poses])
        offsets = np.asarray(points, dtype=np.float64)[None] - origins[:, None]
        local: FloatArray = offsets @ matrix(poses[0])[:2, :2]
        return local

    def _bumps(self, distances: FloatArray) -> FloatArray:
        """Return the heights (m), (9, n), of the pyramids as far as ``distances`` (9, n) from their axes."""
        rise: FloatArray = self._slopes[self._standing][:, None] * (self.pitch / 2.0 - distances)
        return np.maximum(rise, 0.0)

    def _on_platform(self, points: ArrayLike) -> FloatArray:
        """Return how far (m) points (n, 2) are within the platform's border; negative outside."""
        pose = self.platform
        local = (np.asarray(points, dtype=np.float64) - pose.position[:2]) @ matrix(pose)[:2, :2]
        within: FloatArray = (np.array(self.platform_size) / 2.0 - np.abs(local)).min(axis=1)
        return within

    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the heights of pyramids and platform."""
        bumps = self._bumps(np.abs(self._local(points)).max(axis=2)).max(axis=0)
        return np.where(self._on_platform(points) >= 0.0, self.level, bumps)

    def normal(self, xy: Point) -> Vector:
        """Return the normal of the pyramid's side there, or the vertical on the platform."""
        local = self._local([xy])[:, 0]
        bumps = self._bumps(np.abs(local).max(axis=1)[:, None])[:, 0]
        number = int(bumps.argmax())
        if bumps[number] == 0.0 or self._on_platform([xy])[0] >= 0.0:
            return UP
        axis = int(np.abs(local[number]).argmax())
        gradient = np.zeros(2)
        gradient[axis] = math.copysign(float(self._slopes[self._standing[number]]), local[number, axis])
        standing = self._world.poses[self._pyramids[self._standing[number]].index]
        x, y = (matrix(standing)[:2, :2] @ gradient).tolist()
        length = math.sqrt(x * x + y * y + 1.0)
        return (x / length, y / length, 1.0 / length)

    def highest(self, footprint: Footprint) -> float:
        """Return a height (m) that the ground under a footprint does not exceed."""
        if footprint.gap(Footprint.rectangle(self.platform_size, self.platform)) < 0.0:
            return self.level
        local = self._local(footprint.points)
        beside = np.maximum(np.maximum(local.min(axis=1), -local.max(axis=1)), 0.0)
        return float(self._bumps(beside.max(axis=1)[:, None]).max())

    def lay(self, body: BodySpec, xy: Point, yaw: float) -> Pose:
        """Return an upright pose just above the highest ground under the body, which then comes to rest."""
        low = float(body.mesh.bounds[0, 2])
        upright = Pose.planar(*xy, 0.0, yaw)
        return Pose.planar(*xy, self.highest(Footprint.of(body.mesh.vertices, upright)) - low, yaw)

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Whether a footprint is inside the workspace and clear of the platform."""
        platform = Footprint.rectangle(self.platform_size, self.platform)
        return super().fits(footprint, margin) and footprint.gap(platform) >= self._room

    def fits_site(self, footprint: Footprint) -> bool:
        """Whether a footprint is on the platform."""
        return bool(self._on_platform(footprint.points).min() >= -1e-9)

    def _sites(self, size: Point, rng: np.random.Generator, spread: float) -> Iterator[Pose]:
        """Draw frames on the platform with the platform's yaw."""
        x, y = ((a - b) / 2.0 for a, b in zip(self.platform_size, size, strict=True))
        if x >= 0.0 and y >= 0.0:
            offset = Pose((float(rng.uniform(-x, x)), float(rng.uniform(-y, y)), 0.0))
            yield self.platform.compose(offset)

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Draw a point at least ``margin`` (m) from the border, clear of the platform.

        :raises PlacementError: the workspace is narrower than twice the margin
        :raises PlacementError: the platform leaves no such point
        """
        for _ in range(ATTEMPTS):
            point = super().sample_position(rng, margin)
            if self._on_platform([point])[0] <= -COVERED_SHARE * margin:
                return point
        raise PlacementError(f"workspace: the platform leaves no room for a margin of {margin:.3f} m")
