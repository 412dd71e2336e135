"""Sensors that are cameras: color images and point clouds."""

from collections.abc import Mapping, Sequence

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.cameras import aimed, sight
from bulletarm_gym.config_checks import check_argument, field_of_view, integer, optional, point
from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import View
from bulletarm_gym.simulation import Camera

EYE, TARGET = (0.55, -0.45, 0.6), (0.0, 0.0, 0.05)
"""Default position, in front and to one side, and target (m), from the centre of a default workspace."""
PICTURE = 84
"""Default pixels a side: fewer than a heightmap has, so that learners do not use both as views of the same
square."""
LARGEST_PICTURE = 1024
"""Largest number of pixels a side."""
MOST_POINTS = 65536
CLOUD_PIXELS = 128
"""Pixels a side of the depth images that points are taken from."""


class Rgb(Sensor):
    """Image of a fixed camera; the arm is visible.

    :param position: position (m, world); by default the camera looks at the workspace from the front
    :param target: point (m, world) in the middle of the image; straight down, rows grow with world x and
        columns with y
    :param size: pixels a side
    :param fov: field of view (degrees)
    :raises ValueError: a parameter has a value that it does not accept
    """

    def __init__(
        self,
        scene: Scene,
        position: Sequence[float] | None = None,
        target: Sequence[float] | None = None,
        size: int = PICTURE,
        fov: float = Camera.fov,
    ) -> None:
        super().__init__(scene)
        eye, middle = sight(scene, EYE, TARGET)
        eye = tuple(check_argument("position", position, optional(point)) or eye)
        middle = tuple(check_argument("target", target, optional(point)) or middle)
        size = check_argument("size", size, integer(16, LARGEST_PICTURE))
        self._camera = aimed(eye, middle, check_argument("fov", fov, field_of_view), size, size)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The camera."""
        return {"": self._camera}

    @property
    def space(self) -> spaces.Box:
        """Red, green and blue, (3, size, size)."""
        return spaces.Box(0, 255, (3, self._camera.height, self._camera.width), np.uint8)

    def read(self, view: View) -> NDArray[np.uint8]:
        """Return the picture."""
        return np.ascontiguousarray(self._camera.color(self.scene.world).transpose(2, 0, 1))


class PointCloud(Sensor):
    """Points on what two depth cameras at the workspace's sides see (paper, Close-loop Environments).

    The arm and the endless ground are taken out, as is what lies beyond the square that the heightmap shows
    and, in open loop, what is held. Of the points left as many as are asked for are taken at even steps,
    camera by camera and row by row: some twice where there are fewer, zeros where there is none.

    :param points: number of points
    :raises ValueError: ``points`` is not such a number
    """

    def __init__(self, scene: Scene, points: int = 1024) -> None:
        super().__init__(scene)
        self._count = check_argument("points", points, integer(1, MOST_POINTS))
        self._cameras = scene.side_cameras(CLOUD_PIXELS)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The two cameras, the first at the lower y."""
        return {f"_{number}": camera for number, camera in enumerate(self._cameras)}

    @property
    def space(self) -> spaces.Box:
        """Metres, (points, 3)."""
        return spaces.Box(-np.inf, np.inf, (self._count, 3), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return points along the world's axes, from the fingertips or, in open loop, from the middle of the
        workspace's floor.
        """
        found = self._seen(view)
        if not len(found):
            return np.zeros((self._count, 3), np.float32)
        return found[np.linspace(0, len(found) - 1, self._count).round().astype(np.int64)].astype(np.float32)

    def _seen(self, view: View) -> FloatArray:
        world, robot, frame = self.scene.world, self.scene.robot, view.frame
        grasped = [robot.held] if frame.hides_grasped and robot.held is not None else []
        absent = [robot.body, world.ground, *grasped]
        points = np.concatenate([camera.points(world, absent) for camera in self._cameras])
        points = points - frame.origin.position
        inside: FloatArray = points[(np.abs(points[:, :2]) <= frame.extent / 2.0).all(axis=1)]
        return inside
