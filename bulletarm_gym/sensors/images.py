"""Images of the scene from straight above."""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.rendering.overlays import fill_rectangles, rectangle_mask
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import MAX_HEIGHT, View


class Heightmap(Sensor):
    """Heights, or in close loop depths, with the overlays of the task and the two squares of the gripper."""

    @property
    def space(self) -> spaces.Box:
        """Metres, (1, size, size); rows grow with world x, columns with y."""
        size = self.scene.config.obs_size
        return spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return heights above the workspace's floor, or depths below a plane over the fingertips."""
        frame, heights = view.frame, view.heights.copy()
        for overlay in view.overlays:
            covered = rectangle_mask(frame.centre, frame.extent, view.size, [overlay.rectangle])
            heights[covered] += np.float32(overlay.rise)
        if frame.plane is None:
            image = (heights - np.float32(frame.origin.z)).clip(0.0, MAX_HEIGHT)
        else:
            image = np.clip(np.float32(frame.plane) - heights, 0.0, MAX_HEIGHT)
        if frame.fingers is not None:
            fill_rectangles(image, frame.centre, frame.extent, frame.fingers, 0.0)
        return image[None]
