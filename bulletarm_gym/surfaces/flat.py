"""The flat floor."""

import numpy as np

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation import BodySpec, Box, Piece, World
from bulletarm_gym.surfaces.surface import Surface

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
        world.add_plane(FLOOR)

    def height(self, x: float, y: float) -> float:
        """Return 0 everywhere."""
        return 0.0

    def normal(self, x: float, y: float) -> Vector:
        """Return the vertical everywhere."""
        return (0.0, 0.0, 1.0)

    def rest_pose(self, x: float, y: float, lift: float, rng: np.random.Generator, spread: float) -> Pose:
        """Return an upright pose with a random yaw."""
        return Pose.planar(x, y, lift, float(rng.uniform(-spread, spread)))
