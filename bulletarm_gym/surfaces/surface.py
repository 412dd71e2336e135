"""What tasks may ask of the ground without knowing its shape."""

from abc import ABC, abstractmethod

import numpy as np

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation import World


class Surface(ABC):
    """The ground of a workspace."""

    @abstractmethod
    def load(self, world: World) -> None:
        """Load the surface's bodies, once."""

    @abstractmethod
    def height(self, x: float, y: float) -> float:
        """Return the height (m) of the ground at a point of the world."""

    @abstractmethod
    def normal(self, x: float, y: float) -> Vector:
        """Return the unit normal of the ground at a point of the world."""

    @abstractmethod
    def rest_pose(self, x: float, y: float, lift: float, rng: np.random.Generator, spread: float) -> Pose:
        """Return the pose of a body that stands on the ground.

        :param lift: height (m) of the body's frame above the ground, along its normal
        :param rng: draws the yaw
        :param spread: the yaw is uniform in +-spread (rad)
        """
