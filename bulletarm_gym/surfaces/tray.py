"""The floor of a tray that stands in the workspace."""

import numpy as np

from bulletarm_gym.geometry import Footprint, PlacementError, Pose
from bulletarm_gym.objects.tray import FLOOR_HEIGHT, RIM, tray_floor, tray_walls
from bulletarm_gym.simulation import World
from bulletarm_gym.surfaces.flat import FlatSurface
from bulletarm_gym.surfaces.surface import COVERED_SHARE, SITE, Point

SIZE = 5.0 / 6.0
"""Nominal side of the tray in sides of the workspace: 25 cm for the close-loop 30 cm."""


class TraySurface(FlatSurface):
    """A tray in the middle of the workspace; what is placed on it stands on its floor."""

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        super().__init__(workspace, site)
        self.size = SIZE * (workspace[0][1] - workspace[0][0])

    @property
    def level(self) -> float:
        """Height (m) of the tray's floor, also asked for its walls: nothing is placed on them."""
        return FLOOR_HEIGHT

    @property
    def floor_side(self) -> float:
        """Side (m) of the level floor."""
        return self.size - RIM

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Draw a point from which an item with this margin (m) to the workspace's border stays on the floor.

        :raises PlacementError: the floor is too small for the item
        """
        reach = self.floor_side / 2.0 - COVERED_SHARE * margin
        if reach < 0.0:
            raise PlacementError(
                f"workspace: its tray of {self.floor_side:.3f} m has no room for a margin of {margin:.3f} m"
            )
        dx, dy = rng.uniform(-reach, reach, 2).tolist()
        return self.centre[0] + dx, self.centre[1] + dy

    def load(self, world: World) -> None:
        """Load the ground and the tray on it."""
        super().load(world)
        for spec in (tray_floor(self.size), tray_walls(self.size)):
            self.bodies.append(world.add(spec, Pose((*self.centre, 0.0))))

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Whether a footprint is on the floor, a margin (m) away from the walls."""
        half = self.floor_side / 2.0
        return footprint.is_inside([[middle - half, middle + half] for middle in self.centre], margin)
