"""Perspective cameras, headless: pictures of the whole scene, and what a depth camera would measure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Vector
from bulletarm_gym.simulation.state import Body
from bulletarm_gym.simulation.world import World

LIGHT = (0.6, -0.9, 1.6)
VERTICAL = 1e-3
"""Slope from the vertical (m a metre) below which a camera looks straight down or up."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    :param eye: where it stands (m, world)
    :param target: what it looks at (m, world)
    :param fov: vertical field of view (degrees)
    :param near: nearest distance seen (m)
    :param far: farthest distance seen (m)
    """

    eye: Vector = (1.4, -0.95, 0.95)
    target: Vector = (0.27, 0.0, 0.33)
    fov: float = 42.0
    width: int = 480
    height: int = 480
    near: float = 0.05
    far: float = 4.0

    def color(self, world: World) -> NDArray[np.uint8]:
        """Return a picture, (height, width, 3)."""
        pixels = np.asarray(self._shoot(world, shadow=True)[2], dtype=np.uint8)
        return pixels.reshape(self.height, self.width, 4)[:, :, :3].copy()

    def depth(self, world: World) -> NDArray[np.float32]:
        """Return distances (m) along the optical axis, (height, width)."""
        return self._distances(self._shoot(world)).astype(np.float32)

    def points(self, world: World, without: Sequence[Body]) -> FloatArray:
        """Return the points (n, 3) of the world (m) that the camera sees, less those on some bodies."""
        image = self._shoot(world)
        distances = self._distances(image)
        shown = np.asarray(image[4]).reshape(distances.shape)
        seen = ~np.isin(shown, [body.id for body in without]) & (distances < self.far * 0.99)
        rows, columns = np.nonzero(seen)
        along = distances[rows, columns]
        right, up, forward = self._axes()
        tangent = np.tan(np.radians(self.fov) / 2.0)
        across = (2.0 * (columns + 0.5) / self.width - 1.0) * tangent * self.width / self.height
        upward = (1.0 - 2.0 * (rows + 0.5) / self.height) * tangent
        rays = forward + across[:, None] * right + upward[:, None] * up
        points: FloatArray = np.asarray(self.eye) + along[:, None] * rays
        return points

    def project(self, point: Vector) -> tuple[float, float]:
        """Return the column and row (pixels) of a point of the world (m)."""
        right, up, forward = self._axes()
        offset = np.subtract(point, self.eye)
        scale = self.height / (2.0 * math.tan(math.radians(self.fov) / 2.0) * float(offset @ forward))
        return self.width / 2.0 + scale * float(offset @ right), self.height / 2.0 - scale * float(
            offset @ up
        )

    @property
    def _up(self) -> Vector:
        """What is upwards in the image; straight down, rows grow with world x and columns with y."""
        across = math.hypot(self.eye[0] - self.target[0], self.eye[1] - self.target[1])
        return (0.0, 0.0, 1.0) if across > VERTICAL * abs(self.eye[2] - self.target[2]) else (-1.0, 0.0, 0.0)

    def _axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self._up)
        right /= np.linalg.norm(right)
        return right, np.cross(right, forward), forward

    def _distances(self, image: tuple[Any, ...]) -> FloatArray:
        buffer = np.asarray(image[3], dtype=np.float64).reshape(self.height, self.width)
        distances: FloatArray = self.far * self.near / (self.far - (self.far - self.near) * buffer)
        return distances

    def _shoot(self, world: World, shadow: bool = False) -> tuple[Any, ...]:
        client = world.client
        view = client.computeViewMatrix(self.eye, self.target, self._up)
        projection = client.computeProjectionMatrixFOV(
            self.fov, self.width / self.height, self.near, self.far
        )
        image: tuple[Any, ...] = client.getCameraImage(
            self.width,
            self.height,
            view,
            projection,
            lightDirection=LIGHT,
            shadow=int(shadow),
            renderer=client.ER_TINY_RENDERER,
        )
        return image
