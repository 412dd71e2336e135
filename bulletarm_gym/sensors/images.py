"""Images of the scene from straight above."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import ORTHOGRAPHIC
from bulletarm_gym.rendering.overlays import fill_rectangles, rectangle_mask
from bulletarm_gym.scene.scene import SIDE_PIXELS
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import MAX_HEIGHT, Frame, Heights, View
from bulletarm_gym.simulation import Camera

FINGER_COLOUR = (40, 40, 40)
"""Colour of the squares that stand for the fingers."""
GRIPPER = 255
"""Their number in the segmentation; nothing else has it."""


class Heightmap(Sensor):
    """Heights, or in close loop depths, with the overlays of the task and the two squares of the gripper."""

    @property
    def space(self) -> spaces.Box:
        """Metres, (1, size, size); rows grow with world x, columns with y."""
        size = self.scene.config.obs_size
        return spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The two cameras of the view ``"point_cloud"``, the first at the lower y."""
        if self.scene.config.view == ORTHOGRAPHIC:
            return {}
        return {f"_{number}": camera for number, camera in enumerate(self.scene.side_cameras(SIDE_PIXELS))}

    def read(self, view: View) -> NDArray[np.float32]:
        """Return heights above the workspace's floor, or depths below a plane over the fingertips."""
        frame, heights = view.frame, view.heights.copy()
        for overlay in view.overlays:
            covered = rectangle_mask(frame.centre, frame.extent, view.size, [overlay.rectangle])
            heights[covered] += np.float32(overlay.rise)
        return heightmap(heights, frame)


def heightmap(heights: Heights, frame: Frame) -> Heights:
    """Return what a frame shows of heights: above its origin or below its plane, with its fingers at 0.

    :param heights: (size, size) m above the world's z = 0 over the frame's square
    :return: (1, size, size) m, within [0, 0.4]
    """
    if frame.plane is None:
        image = (heights - np.float32(frame.origin.z)).clip(0.0, MAX_HEIGHT)
    else:
        image = np.clip(np.float32(frame.plane) - heights, 0.0, MAX_HEIGHT)
    if frame.fingers:
        fill_rectangles(image, frame.centre, frame.extent, frame.fingers, 0.0)
    return image[None]


class Color(Sensor):
    """Colours of what the heightmap shows, unshaded, with the two squares of the gripper in dark grey."""

    asks_for_labels = True

    @property
    def space(self) -> spaces.Box:
        """Red, green and blue, (3, size, size)."""
        size = self.scene.config.obs_size
        return spaces.Box(0, 255, (3, size, size), np.uint8)

    def read(self, view: View) -> NDArray[np.uint8]:
        """Return the colour of the body under each pixel's centre, or of the ground."""
        image: NDArray[np.uint8] = np.take(self._palette, view.labels, axis=1)
        image[:, view.fingers] = np.array(FINGER_COLOUR, np.uint8)[:, None]
        return image

    @property
    def _palette(self) -> NDArray[np.uint8]:
        """Colour of each label, (3, labels)."""
        world = self.scene.world
        colours = [world.get_properties(world.ground).colour, *self.scene.colours]
        return np.rint(255.0 * np.array(colours)[:, :3].T).astype(np.uint8)


class Segmentation(Sensor):
    """Which item is seen where the heightmap shows something.

    0 is the ground and whatever the task stands on, n the n-th item in the order of the task's ``bodies()``,
    whoever plays its role, and 255 the two squares of the gripper.
    """

    asks_for_labels = True

    @property
    def space(self) -> spaces.Box:
        """Numbers of items, (1, size, size)."""
        size = self.scene.config.obs_size
        return spaces.Box(0, 255, (1, size, size), np.uint8)

    def read(self, view: View) -> NDArray[np.uint8]:
        """Return the number of the item under each pixel's centre."""
        image = self._numbers[view.labels]
        image[view.fingers] = GRIPPER
        return image[None]

    @cached_property
    def _numbers(self) -> NDArray[np.uint8]:
        """Number of the item of each label."""
        items = self.scene.objects
        number_of = {body.index: number for number, item in enumerate(items, 1) for body in item.bodies}
        return np.array([0, *(number_of.get(body.index, 0) for body, _ in self.scene.parts)], np.uint8)
