"""What people need to look at a scene and to play in it."""

import math

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import Vector
from bulletarm_gym.observations.cameras import render_camera, viewpoint
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera
from bulletarm_gym.simulation.window import Keyboard, draw_segments, look

EYE_OFFSET = (0.56, -0.4, 0.62)
"""From the middle of the workspace's floor to the camera of close-ups (m) ..."""
TARGET_HEIGHT = 0.03
"""... which looks at a point this high (m) over it ..."""
FIELD_OF_VIEW = 32.0
"""... with this field of view (degrees)."""
MARK_HEIGHT = 0.3
"""Length (m) of the line that stands on a target."""
MARK_REACH = 0.04
"""Length (m) of the lines to where the fingers come down."""


class Viewer:
    """A person's eyes and hands on an environment.

    :param scene: what is looked at
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._mark: list[int] = []
        self._keyboard: Keyboard | None = None

    def close_up(self, pixels: int = 240) -> NDArray[np.uint8]:
        """Return a picture of the workspace from the front and above, (pixels, pixels, 3)."""
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
        """Return the characters whose keys went down in the window since the last call.

        :raises RuntimeError: there is no window: the environment's ``render_mode`` is not ``"human"``
        """
        if self._scene.config.render_mode != "human":
            raise RuntimeError('pressed_keys: keys are pressed in a window; use render_mode="human"')
        if self._keyboard is None:
            self._keyboard = Keyboard(self._scene.world)
        return self._keyboard.pressed()

    def mark(self, position: Vector, yaw: float = 0.0) -> None:
        """Show in the window where the gripper would go.

        :param position: of the fingertips (m, world)
        :param yaw: of the gripper (rad): the fingers come down along this direction
        """
        x, y, z = position
        right, ahead = MARK_REACH * math.cos(yaw), MARK_REACH * math.sin(yaw)
        across = ((x - right, y - ahead, z), (x + right, y + ahead, z))
        self._mark = draw_segments(
            self._scene.world, [(position, (x, y, z + MARK_HEIGHT)), across], self._mark
        )
