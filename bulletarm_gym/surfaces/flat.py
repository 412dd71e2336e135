"""Flat floor, and the floor of a tray on it."""

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose, Vector
from bulletarm_gym.objects.containers import FLOOR_HEIGHT, RIM, tray_floor, tray_walls
from bulletarm_gym.simulation import BodySpec, Box, Piece, World
from bulletarm_gym.surfaces.surface import COVERED_SHARE, SITE, UP, Point, Surface

FLOOR = BodySpec(
    "floor",
    (Piece(Box((3.0, 3.0, 0.01)), Pose((0.0, 0.0, -0.005))),),
    mass=0.0,
    colour=(0.79, 0.84, 0.89, 1.0),
)
"""Visible part of the ground plane z = 0."""


class FlatSurface(Surface):
    """The plane z = 0."""

    def load(self, world: World) -> None:
        """Load the ground plane."""
        self.bodies.append(world.add_plane(FLOOR))

    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the level everywhere."""
        return np.full(len(np.asarray(points)), self.level)

    def normal(self, xy: Point) -> Vector:
        """Return the vertical everywhere."""
        return UP


class TraySurface(FlatSurface):
    """Floor of a tray at the centre of the workspace, whose height is returned for all points."""

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        super().__init__(workspace, site)
        self._size = 5.0 / 6.0 * (workspace[0][1] - workspace[0][0])  # 25 cm in the close-loop 30 cm
        self._side = self._size - RIM

    def load(self, world: World) -> None:
        """Load the ground plane and the tray."""
        super().load(world)
        for spec in (tray_floor(self._size), tray_walls(self._size)):
            self.bodies.append(world.add(spec, Pose((*self.centre, 0.0))))

    @property
    def level(self) -> float:
        """Height (m) of the tray's floor."""
        return FLOOR_HEIGHT

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Return True if a footprint is on the floor, ``margin`` (m) from the walls."""
        half = self._side / 2.0
        return footprint.is_inside([[middle - half, middle + half] for middle in self.centre], margin)

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Sample a point at which an object with this margin (m) to the workspace's border is on the floor.

        :raises PlacementError: the floor is too small for the object
        """
        reach = self._side / 2.0 - COVERED_SHARE * margin
        if reach < 0.0:
            raise PlacementError(
                f"workspace: its tray of {self._side:.3f} m has no room for a margin of {margin:.3f} m"
            )
        dx, dy = rng.uniform(-reach, reach, 2).tolist()
        return self.centre[0] + dx, self.centre[1] + dy
