"""What tasks may ask of the ground without knowing its shape."""

from abc import ABC, abstractmethod
from typing import TypeAlias

import numpy as np

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation import World

Point: TypeAlias = tuple[float, float]


class Surface(ABC):
    """The ground of a workspace.

    :param workspace: [[x low, x high], [y low, y high], [z low, z high]] (m)
    """

    def __init__(self, workspace: list[list[float]]) -> None:
        self.workspace = workspace

    @abstractmethod
    def load(self, world: World) -> None:
        """Load the surface's bodies, once."""

    @abstractmethod
    def height(self, xy: Point) -> float:
        """Return the height (m) of the ground at a point of the world."""

    @abstractmethod
    def normal(self, xy: Point) -> Vector:
        """Return the unit normal of the ground at a point of the world."""

    @abstractmethod
    def pose(self, xy: Point, yaw: float) -> Pose:
        """Return the frame of something that lies on the ground at a point, turned by ``yaw`` (rad)."""

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Draw a point of the workspace at least ``margin`` (m) from its border.

        :raises ValueError: the workspace is narrower than twice the margin
        """
        (x0, x1), (y0, y1) = self.workspace[:2]
        if x1 - x0 < 2.0 * margin:
            raise ValueError(f"workspace: {self.workspace[:2]} leaves nothing {margin:.3f} m from its border")
        return float(rng.uniform(x0 + margin, x1 - margin)), float(rng.uniform(y0 + margin, y1 - margin))
