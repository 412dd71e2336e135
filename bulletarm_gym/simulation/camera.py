"""A perspective camera for pictures of the whole scene, headless."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import Vector
from bulletarm_gym.simulation.world import World

NEAR = 0.05
FAR = 4.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    :param eye: where it stands (m, world)
    :param target: what it looks at (m, world)
    :param fov: vertical field of view (degrees)
    :param width: pixels
    :param height: pixels
    """

    eye: Vector = (1.25, -0.85, 0.8)
    target: Vector = (0.3, 0.0, 0.24)
    fov: float = 42.0
    width: int = 480
    height: int = 480

    def color(self, world: World) -> NDArray[np.uint8]:
        """Return a picture, (height, width, 3)."""
        pixels = np.asarray(self._shoot(world)[2], dtype=np.uint8)
        return pixels.reshape(self.height, self.width, 4)[:, :, :3].copy()

    def depth(self, world: World) -> NDArray[np.float32]:
        """Return distances (m) along the optical axis, (height, width)."""
        buffer = np.asarray(self._shoot(world)[3], dtype=np.float64).reshape(self.height, self.width)
        return (FAR * NEAR / (FAR - (FAR - NEAR) * buffer)).astype(np.float32)

    def _shoot(self, world: World) -> tuple[int, int, object, object, object]:
        client = world.client
        view = client.computeViewMatrix(self.eye, self.target, (0.0, 0.0, 1.0))
        projection = client.computeProjectionMatrixFOV(self.fov, self.width / self.height, NEAR, FAR)
        image: tuple[int, int, object, object, object] = client.getCameraImage(
            self.width,
            self.height,
            view,
            projection,
            lightDirection=LIGHT,
            shadow=1,
            renderer=client.ER_TINY_RENDERER,
        )
        return image


LIGHT = (0.6, -0.9, 1.6)
