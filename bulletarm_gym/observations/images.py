"""Images of the scene from straight above: heightmap, colours and segmentation."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import ORTHOGRAPHIC
from bulletarm_gym.config_checks import check_argument, choice
from bulletarm_gym.observations.cameras import SIDE_PIXELS, side_cameras
from bulletarm_gym.observations.rasterizer import Window, rectangle_mask
from bulletarm_gym.observations.sensor import Sensor
from bulletarm_gym.observations.view import MAX_HEIGHT, Frame, HeightRenderer, Heights, View
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera

FINGER_COLOUR = (40, 40, 40)
"""Colour of the squares that represent the fingers."""
GRIPPER = 255
"""Number of the squares that represent the fingers in the segmentation."""


class Heightmap(Sensor):
    """Heights or, in close loop, depths, with the overlays of the task and the two squares of the fingers."""

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
    if frame.plane is None:
        image = (heights - np.float32(frame.origin.z)).clip(0.0, MAX_HEIGHT)
    else:
        image = np.clip(np.float32(frame.plane) - heights, 0.0, MAX_HEIGHT)
    if frame.fingers:
        image[rectangle_mask(Window(frame.centre, frame.extent, len(image)), frame.fingers)] = 0.0
    return image[None]


class LabelImage(Sensor):
    """Image with a value for each visible mesh, see :attr:`View.labels`.

    :raises ValueError: the parameter ``view`` is not ``"orthographic"``
    """

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
        colours = [world.get_properties(world.ground).colour, *HeightRenderer.of(self.scene).colours]
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
        objects = enumerate(self.scene.objects, 1)
        number_of = {body.index: number for number, obj in objects for body in obj.bodies}
        bodies = HeightRenderer.of(self.scene).bodies
        return np.array([0, *(number_of.get(body.index, 0) for body in bodies)], np.uint8)
