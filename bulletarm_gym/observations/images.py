"""Images of the scene from straight above: heightmap, colours and segmentation."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from bulletarm_gym.config import OPEN_LOOP, ORTHOGRAPHIC
from bulletarm_gym.config_checks import check_argument, choice
from bulletarm_gym.geometry import FloatArray, Pose, matrix
from bulletarm_gym.observations.cameras import SIDE_PIXELS, side_cameras
from bulletarm_gym.observations.rasterizer import Window, rectangle_mask
from bulletarm_gym.observations.sensor import Sensor
from bulletarm_gym.observations.view import MAX_HEIGHT, ElevationMap, Frame, HeightRenderer, Heights, View
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera

FINGER_COLOUR = (40, 40, 40)
"""Colour of the squares that represent the fingers."""
GRIPPER = 255
"""Number of the squares that represent the fingers in the segmentation."""


class Heightmap(Sensor):
    """Heights (open loop) or depths, with the overlays of the task and the two squares of the fingers."""

    @property
    def space(self) -> spaces.Box:
        """Metres, (1, size, size); rows grow with world x, columns with y."""
        size = self.scene.config.obs_size
        return spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The two cameras of the view ``"point_cloud"``, the lower y first."""
        config = self.scene.config
        if config.view == ORTHOGRAPHIC:
            return {}
        return {f"_{number}": camera for number, camera in enumerate(side_cameras(config, SIDE_PIXELS))}

    def read(self, view: View) -> NDArray[np.float32]:
        """Return heights above the workspace's floor, or depths below the camera plane."""
        heights = view.heights.copy()
        for overlay in view.overlays:
            heights[rectangle_mask(view.window, [overlay.rectangle])] += np.float32(overlay.rise)
        return heightmap(heights, view.frame)


def heightmap(heights: Heights, frame: Frame) -> Heights:
    """Return heights above a frame's origin or depths below its plane, with its fingers at 0.

    :param heights: (size, size) m above the world's z = 0 over the frame's square
    :return: (1, size, size) m, within [0, 0.4]
    """
    origin, plane = np.float32(frame.origin.z), frame.plane
    image = heights - origin if plane is None else np.float32(plane) - heights
    image[rectangle_mask(Window(frame.centre, frame.extent, len(image)), frame.fingers)] = 0.0
    return image[None].clip(0.0, MAX_HEIGHT)


class LabelImage(Sensor):
    """Orthographic image with a value for each visible mesh, see :attr:`View.labels`."""

    channels = 1

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        check_argument("view", scene.config.view, choice(ORTHOGRAPHIC))

    @property
    def space(self) -> spaces.Box:
        """Bytes, (channels, size, size)."""
        size = self.scene.config.obs_size
        return spaces.Box(0, 255, (self.channels, size, size), np.uint8)


class Color(LabelImage):
    """Unshaded colours of the square of the heightmap, with the two squares of the fingers in dark grey."""

    channels = 3

    def read(self, view: View) -> NDArray[np.uint8]:
        """Return the colour of the body under the centre of each pixel, or of the ground."""
        world = self.scene.world
        colours = [world.get_properties(world.ground).colour]
        for body in world.visible:
            colours += [world.get_properties(body).colour, *(part.colour for part in body.spec.parts)]
        palette = np.rint(255.0 * np.array(colours)[:, :3].T).astype(np.uint8)
        image: NDArray[np.uint8] = np.take(palette, view.labels, axis=1)
        image[:, view.fingers] = np.array(FINGER_COLOUR, np.uint8)[:, None]
        return image


class Segmentation(LabelImage):
    """Number of the visible object of each pixel of the heightmap.

    0 is the surface, n the n-th slot of the task's ``bodies()``, whichever variant is in the scene, and 255
    the two squares of the fingers.
    """

    def read(self, view: View) -> NDArray[np.uint8]:
        """Return the number of the object under the centre of each pixel."""
        image = self._numbers[view.labels]
        image[view.fingers] = GRIPPER
        return image[None]

    @cached_property
    def _numbers(self) -> NDArray[np.uint8]:
        """Number of the object of each label."""
        objects = enumerate(self.scene.all_objects, 1)
        number_of = {body.index: number for number, obj in objects for body in obj.bodies}
        bodies = HeightRenderer.of(self.scene).bodies
        return np.array([0, *(number_of.get(body.index, 0) for body in bodies)], np.uint8)


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
        channels, size, _ = self._shape
        self.memory = pick and in_hand_image(before.elevation_map, pick, size, channels == 3).tobytes()


def in_hand_image(view: ElevationMap, pick: Pose, size: int, tilts: bool) -> Heights:
    """Return the image of an elevation map around a pick (world), with three channels if actions tilt."""
    image, above_floor = projections if tilts else rotated_crop, Pose((0.0, 0.0, -view.floor)).compose(pick)
    return image(view, above_floor, size).clip(0.0, MAX_HEIGHT)


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
