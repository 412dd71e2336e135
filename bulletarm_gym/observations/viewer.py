"""Close-up images of a scene, and the keys and marks of its window."""

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import Vector
from bulletarm_gym.observations.cameras import close_up_camera, render_camera
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation.window import Keyboard, draw_segments, look

PIXELS = 240
"""Default pixels a side of close-ups."""
MARK_HEIGHT = 0.3
"""Length (m) of the vertical line of a mark."""
MARK_REACH = 0.04
"""Distance (m) from a mark to the ends of its horizontal line."""


class Viewer:
    """Images and user input for playing.

    :param scene: the scene to show
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._mark: list[int] = []

    def close_up(self, pixels: int = PIXELS) -> NDArray[np.uint8]:
        """Return an image of the workspace from the front and above, (pixels, pixels, 3)."""
        return close_up_camera(self._scene, pixels).color(self._scene.world)

    def face_workspace(self) -> None:
        """Show the workspace in the window, from the configured camera or from that of close-ups."""
        scene = self._scene
        camera = render_camera(scene) if scene.config.render_camera else close_up_camera(scene, PIXELS)
        look(scene.world, camera.eye, camera.target)

    def pressed_keys(self) -> list[str]:
        """Return the characters of the keys that were pressed in the window since the last call.

        :raises RuntimeError: the environment's ``render_mode`` is not ``"human"``
        """
        mode = self._scene.config.render_mode
        if mode != "human":
            raise RuntimeError(f"render_mode must be 'human' for pressed_keys(), got {mode!r}")
        return self._keyboard.pressed()

    @cached_property
    def _keyboard(self) -> Keyboard:
        return Keyboard(self._scene.world)

    def mark(self, position: Vector, yaw: float = 0.0) -> None:
        """Draw a target pose of the gripper in the window.

        :param position: position (m) of the fingertips in the world
        :param yaw: yaw (rad) of the gripper, whose fingers open along this direction
        """
        x, y, z = position
        right, ahead = MARK_REACH * math.cos(yaw), MARK_REACH * math.sin(yaw)
        lines = [
            (position, (x, y, z + MARK_HEIGHT)),
            ((x - right, y - ahead, z), (x + right, y + ahead, z)),
        ]
        self._mark = draw_segments(self._scene.world, lines, self._mark)
