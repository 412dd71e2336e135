"""The in-hand image: what the heightmap showed where the gripper closed (paper, Open-loop Environments)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Pose, matrix

Heights = NDArray[np.float32]


@dataclass(frozen=True)
class Map:
    """Heights over a square of the world.

    :param heights: (n, n) m; rows grow with world x, columns with y
    :param centre: world x and y (m) of its middle
    :param extent: its side (m)
    """

    heights: Heights
    centre: tuple[float, float]
    extent: float

    @property
    def resolution(self) -> float:
        """Side (m) of a pixel."""
        return self.extent / len(self.heights)

    def pixels(self, points: FloatArray) -> FloatArray:
        """Return where points (..., 2 or more; m) are in rows and columns; pixel 0 has its middle at 0."""
        corner = np.array(self.centre) - self.extent / 2.0
        return (points[..., :2] - corner) / self.resolution - 0.5


def crop(view: Map, hand: Pose, size: int) -> Heights:
    """Return the part of a heightmap around the gripper, turned with it; 0 beyond the border.

    :param hand: of the fingertips in the world; its yaw turns the crop
    :param size: pixels a side, each as large as the heightmap's
    :return: (1, size, size) m; rows grow along the gripper's x axis, columns along its y axis, heights
        interpolated between pixels
    """
    offsets = _grid(size, 2) * view.resolution
    turn = matrix(Pose.planar(0.0, 0.0, 0.0, hand.yaw))[:2, :2]
    return _interpolated(view.heights, view.pixels(offsets @ turn.T + hand.position[:2]))[None]


def projections(view: Map, hand: Pose, size: int) -> Heights:
    """Return what lies in a cube around the gripper, seen along its three axes.

    Every voxel under the surface that the heightmap shows is full, one above it or beyond its border empty.

    :param hand: of the fingertips, the middle of the cube, its height as the heightmap's
    :param size: voxels a side, each as large as a pixel of the heightmap
    :return: (3, size, size) m: how much is full along the gripper's x, y and z axes; rows and columns grow
        along the other two, in their order
    """
    points = _grid(size, 3) * view.resolution @ matrix(hand).T + hand.position
    rows, columns = np.floor(view.pixels(points) + 0.5).astype(np.int64).reshape(-1, 2).T
    n = len(view.heights)
    inside = (rows >= 0) & (rows < n) & (columns >= 0) & (columns < n)
    surface = view.heights[rows.clip(0, n - 1), columns.clip(0, n - 1)]
    full = (inside & (points[..., 2].ravel() < surface)).reshape((size,) * 3)
    counts = np.stack([full.sum(axis=axis) for axis in range(3)])
    depths: Heights = (counts * view.resolution).astype(np.float32)
    return depths


def _grid(size: int, dimensions: int) -> FloatArray:
    """Return the cells' middles, (size, ..., dimensions), in cells from the middle of all."""
    line = np.arange(size, dtype=np.float64) - (size - 1) / 2.0
    return np.stack(np.meshgrid(*[line] * dimensions, indexing="ij"), axis=-1)


def _interpolated(image: Heights, places: FloatArray) -> Heights:
    """Return an image's values between its pixels, bilinearly; beyond its border it is 0."""
    padded = np.pad(image, 1)
    places = (places + 1.0).clip(0.0, len(padded) - 1.0)
    low = np.minimum(places.astype(np.int64), len(padded) - 2)
    (rows, columns), (down, right) = np.moveaxis(low, -1, 0), np.moveaxis(places - low, -1, 0)
    upper = padded[rows, columns] * (1.0 - right) + padded[rows, columns + 1] * right
    lower = padded[rows + 1, columns] * (1.0 - right) + padded[rows + 1, columns + 1] * right
    values: Heights = (upper * (1.0 - down) + lower * down).astype(np.float32)
    return values
