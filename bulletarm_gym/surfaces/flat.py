"""The flat floor."""

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Pose, Vector
from bulletarm_gym.simulation import BodySpec, Box, Piece, World
from bulletarm_gym.surfaces.surface import UP, Point, Surface

FLOOR = BodySpec(
    "floor",
    (Piece(Box((3.0, 3.0, 0.01)), Pose((0.0, 0.0, -0.005))),),
    mass=0.0,
    colour=(0.79, 0.84, 0.89, 1.0),
)


class FlatSurface(Surface):
    """The plane z = 0."""

    def load(self, world: World) -> None:
        """Load the endless plane."""
        self.bodies.append(world.add_plane(FLOOR))

    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the level everywhere."""
        return np.full(len(np.asarray(points)), self.level)

    def normal(self, xy: Point) -> Vector:
        """Return the vertical everywhere."""
        return UP
