"""What cameras see: pictures, and points on what they show."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Vector
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import View
from bulletarm_gym.simulation import Camera

POSITION, TARGET = (1.0, -0.45, 0.6), (0.45, 0.0, 0.05)
"""Where the camera stands and what it looks at (m) unless told: the workspace, from front and side."""
PICTURE = 84
"""Pixels a side unless told: fewer than a heightmap has, so that learners do not take it for another view of
the same square."""
LARGEST_PICTURE = 1024
"""Most pixels a side."""
WIDEST = 170.0
"""Greatest field of view (degrees) whose picture is not all edges."""
MOST_POINTS = 65536
CLOUD_PIXELS = 128
"""Pixels a side of the depth images that points are taken from."""


class Rgb(Sensor):
    """The picture of a camera that stands still; the arm is seen.

    :param position: where the camera stands (m, world)
    :param target: what it looks at (m, world); straight down, rows grow with world x, columns with y
    :param size: pixels a side
    :param fov: field of view (degrees)
    :raises ValueError: one of them is something else
    """

    def __init__(
        self,
        scene: Scene,
        position: Sequence[float] = POSITION,
        target: Sequence[float] = TARGET,
        size: int = PICTURE,
        fov: float = Camera.fov,
    ) -> None:
        super().__init__(scene)
        eye, seen = _point("position", position), _point("target", target)
        if eye == seen:
            raise ValueError(f"target: got {target!r}, takes another point than position")
        _check_whole("size", size, 16, LARGEST_PICTURE)
        if not (_is_number(fov) and 1.0 <= fov <= WIDEST):
            raise ValueError(f"fov: got {fov!r}, takes degrees from 1 to {WIDEST:g}")
        self._camera = Camera(eye, seen, float(fov), size, size)

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
    :raises ValueError: it is something else
    """

    def __init__(self, scene: Scene, points: int = 1024) -> None:
        super().__init__(scene)
        _check_whole("points", points, 1, MOST_POINTS)
        self._count = points
        self._cameras = scene.side_cameras(CLOUD_PIXELS)

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


def _point(name: str, value: Any) -> Vector:
    try:
        x, y, z = (float(number) for number in value)
    except (TypeError, ValueError):
        x = y = z = np.nan
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"{name}: got {value!r}, takes [x, y, z] in metres")
    return (x, y, z)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _check_whole(name: str, value: Any, low: int, high: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{name}: got {value!r}, takes an integer from {low} to {high}")
