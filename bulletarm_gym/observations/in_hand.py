"""In-hand image: the heightmap around the last pick (paper, Open-loop Environments)."""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.geometry import FloatArray, Pose, matrix
from bulletarm_gym.observations.sensor import Sensor
from bulletarm_gym.observations.view import MAX_HEIGHT, ElevationMap, Heights, View


class InHand(Sensor):
    """The heightmap before a pick around the pose of the pick; zeros after a place."""

    controls = (OPEN_LOOP,)

    @property
    def space(self) -> spaces.Box:
        """Metres, (1, s, s), or (3, s, s) if the gripper tilts."""
        return spaces.Box(0.0, MAX_HEIGHT, self._shape, np.float32)

    @property
    def _shape(self) -> tuple[int, int, int]:
        config = self.scene.config
        channels = 3 if config.action_sequence.count("r") == 3 else 1
        return (channels, config.in_hand_size, config.in_hand_size)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return the image of the last pick, whether or not it grasped an object, until a place."""
        if self.memory is None:
            return np.zeros(self._shape, np.float32)
        return np.frombuffer(self.memory, np.float32).reshape(self._shape).copy()

    def follow(self, before: View, pick: Pose | None) -> None:
        """Store the image of a pick, or delete it."""
        self.memory = None if pick is None else self._image(before, pick).tobytes()

    def _image(self, before: View, pick: Pose) -> Heights:
        channels, size, _ = self._shape
        image = projections if channels == 3 else rotated_crop
        above_floor = Pose((0.0, 0.0, -before.frame.origin.z)).compose(pick)
        return image(before.elevation_map, above_floor, size).clip(0.0, MAX_HEIGHT)


def rotated_crop(view: ElevationMap, tcp_pose: Pose, size: int) -> Heights:
    """Return the part of an elevation map around the gripper, rotated with it; 0 beyond the border.

    :param tcp_pose: pose of the fingertips in the world; its yaw rotates the crop
    :param size: pixels a side, at the resolution of the map
    :return: (1, size, size) m; rows grow along the gripper's x axis, columns along its y axis; heights are
        interpolated
    """
    offsets = _grid(size, 2) * view.resolution
    rotation = matrix(Pose.planar(0.0, 0.0, 0.0, tcp_pose.yaw))[:2, :2]
    pixels = view.pixels(offsets @ rotation.T + tcp_pose.position[:2])
    crop: Heights = map_coordinates(
        view.heights, np.moveaxis(pixels, -1, 0), np.float32, order=1, mode="grid-constant"
    )
    return crop[None]


def projections(view: ElevationMap, tcp_pose: Pose, size: int) -> Heights:
    """Return the projections of a voxelised cube around the gripper along its three axes.

    Every voxel below the surface of the elevation map is full, one above it or beyond its border empty.

    :param tcp_pose: pose of the fingertips, the centre of the cube, with its height as in the map
    :param size: voxels a side, at the resolution of the map
    :return: (3, size, size) m: length of the full voxels along the gripper's x, y and z axes; rows and
        columns grow along the other two, in their order
    """
    points = _grid(size, 3) * view.resolution @ matrix(tcp_pose).T + tcp_pose.position
    rows, columns = np.floor(view.pixels(points) + 0.5).astype(np.int64).reshape(-1, 2).T
    n = len(view.heights)
    inside = (rows >= 0) & (rows < n) & (columns >= 0) & (columns < n)
    surface = view.heights[rows.clip(0, n - 1), columns.clip(0, n - 1)]
    full = (inside & (points[..., 2].ravel() < surface)).reshape((size,) * 3)
    counts = np.stack([full.sum(axis=axis) for axis in range(3)])
    depths: Heights = (counts * view.resolution).astype(np.float32)
    return depths


def _grid(size: int, dimensions: int) -> FloatArray:
    """Return the centres of cells, (size, ..., dimensions), in cells from the centre of all."""
    line = np.arange(size, dtype=np.float64) - (size - 1) / 2.0
    return np.stack(np.meshgrid(*[line] * dimensions, indexing="ij"), axis=-1)
