"""Close-up images of a scene, and the keys and marks of its window."""

import math

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import Vector
from bulletarm_gym.observations.cameras import render_camera, viewpoint
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera
from bulletarm_gym.simulation.window import Keyboard, draw_segments, look

EYE_OFFSET = (0.56, -0.4, 0.62)
"""Position (m) of the camera of close-ups, relative to the centre of the workspace's floor."""
TARGET_HEIGHT = 0.03
"""Height (m) above the workspace's floor of the point at which that camera looks."""
FIELD_OF_VIEW = 32.0
"""Field of view (degrees) of that camera."""
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
        self._keyboard: Keyboard | None = None

    def close_up(self, pixels: int = 240) -> NDArray[np.uint8]:
        """Return an image of the workspace from the front and above, (pixels, pixels, 3)."""
        return Camera(*self._sight, FIELD_OF_VIEW, pixels, pixels).color(self._scene.world)

    def face_workspace(self) -> None:
        """Show the workspace in the window, from the configured camera or from that of close-ups."""
        camera = render_camera(self._scene)
        chosen = (camera.eye, camera.target) if self._scene.config.render_camera else self._sight
        look(self._scene.world, *chosen)

    @property
    def _sight(self) -> tuple[Vector, Vector]:
        """Position and target of the camera of close-ups."""
        floor = self._scene.config.workspace[2][0]
        ahead, left, up = EYE_OFFSET
        return viewpoint(self._scene, (ahead, left, floor + up), (0.0, 0.0, floor + TARGET_HEIGHT))

    def pressed_keys(self) -> list[str]:
        """Return the characters of the keys that were pressed in the window since the last call.

        :raises RuntimeError: the environment's ``render_mode`` is not ``"human"``
        """
        mode = self._scene.config.render_mode
        if mode != "human":
            raise RuntimeError(f"render_mode must be 'human' for pressed_keys(), got {mode!r}")
        if self._keyboard is None:
            self._keyboard = Keyboard(self._scene.world)
        return self._keyboard.pressed()

    def mark(self, position: Vector, yaw: float = 0.0) -> None:
        """Draw a target pose of the gripper in the window.

        :param position: position (m) of the fingertips in the world
        :param yaw: yaw (rad) of the gripper, whose fingers open along this direction
        """
        x, y, z = position
        right, ahead = MARK_REACH * math.cos(yaw), MARK_REACH * math.sin(yaw)
        across = ((x - right, y - ahead, z), (x + right, y + ahead, z))
        self._mark = draw_segments(
            self._scene.world, [(position, (x, y, z + MARK_HEIGHT)), across], self._mark
        )
