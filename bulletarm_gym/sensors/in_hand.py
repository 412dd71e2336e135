"""The in-hand image: what the heightmap showed where the gripper closed (paper, Open-loop Environments)."""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.geometry import FloatArray, Pose, matrix
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import MAX_HEIGHT, Heights, Map, View

TILTING = 3
"""Numbers r in the actions of a gripper that tilts."""


class InHand(Sensor):
    """What the heightmap before a pick showed where the gripper closed; zeros after a place."""

    controls = (OPEN_LOOP,)

    @property
    def space(self) -> spaces.Box:
        """Metres, (1, s, s), or (3, s, s) where the gripper tilts."""
        return spaces.Box(0.0, MAX_HEIGHT, self._shape, np.float32)

    @property
    def _shape(self) -> tuple[int, int, int]:
        config = self.scene.config
        tilts = config.action_sequence.count("r") == TILTING
        return (3 if tilts else 1, config.in_hand_size, config.in_hand_size)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return the image of the last pick, whether or not it held, until a place."""
        if self.memory is None:
            return np.zeros(self._shape, np.float32)
        return np.frombuffer(self.memory, np.float32).reshape(self._shape).copy()

    def follow(self, before: View, pick: Pose | None) -> None:
        """Keep the image of a pick, or forget it."""
        self.memory = None if pick is None else self._image(before, pick).tobytes()

    def _image(self, before: View, pick: Pose) -> Heights:
        channels, size, _ = self._shape
        show = projections if channels == 3 else crop
        above_floor = Pose((0.0, 0.0, -before.frame.origin.z)).compose(pick)
        return show(before.map, above_floor, size).clip(0.0, MAX_HEIGHT)


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
