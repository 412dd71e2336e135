"""Sensors with perspective cameras: color images, depth images and point clouds."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym import config_checks as checks
from bulletarm_gym.geometry import rotate
from bulletarm_gym.observations.cameras import look_at, side_cameras, viewpoint
from bulletarm_gym.observations.sensor import Sensor
from bulletarm_gym.observations.view import View
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera

EYE, TARGET = (0.55, -0.45, 0.6), (0.0, 0.0, 0.05)
"""Default position and target (m) of a fixed camera, relative to the centre of a default workspace."""
WRIST_EYE, WRIST_TARGET = (0.0, -0.1, 0.1), (0.0, 0.0, -0.03)
"""Default position and target (m) of a wrist camera, in the frame of the fingertips."""


class CameraSensor(Sensor):
    """Camera that is fixed or moves with the wrist; the arm is visible.

    :param position: position (m); by default a fixed camera shows the workspace from the front, and a wrist
        camera the fingertips from the side
    :param target: point (m) at the centre of the image; if a fixed camera looks straight down, rows grow with
        world x and columns with y
    :param size: pixels a side, or [width, height]
    :param fov: vertical field of view (degrees)
    :param mount: ``"world"`` for a fixed camera, or ``"wrist"``, with position and target in the frame of
        the fingertips
    :raises ValueError: a parameter is out of range
    """

    def __init__(
        self,
        scene: Scene,
        position: Sequence[float] | None = None,
        target: Sequence[float] | None = None,
        size: int | Sequence[int] = 84,
        fov: float = Camera.fov,
        mount: str = "world",
    ) -> None:
        super().__init__(scene)
        self._on_wrist = checks.check_argument("mount", mount, checks.choice("world", "wrist")) == "wrist"
        defaults = (WRIST_EYE, WRIST_TARGET) if self._on_wrist else viewpoint(scene, EYE, TARGET)
        self._mounted = look_at(
            tuple(checks.check_argument("position", position, checks.optional(checks.point)) or defaults[0]),
            tuple(checks.check_argument("target", target, checks.optional(checks.point)) or defaults[1]),
            checks.check_argument("fov", fov, checks.field_of_view),
            checks.check_argument("size", size, checks.render_size),
        )

    @property
    def camera(self) -> Camera:
        """The camera at present."""
        if not self._on_wrist:
            return self._mounted
        tcp_pose, (eye, target) = self.scene.robot.pose, (self._mounted.eye, self._mounted.target)
        up = rotate(tcp_pose.orientation, (-1.0, 0.0, 0.0) if eye[:2] == target[:2] else (0.0, 0.0, 1.0))
        return replace(self._mounted, eye=tcp_pose.transform(eye), target=tcp_pose.transform(target), up=up)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The camera."""
        return {"": self.camera}


class Rgb(CameraSensor):
    """Color image of a camera.

    :param shadow: render shadows. Without shadows, ``depth`` sensors with this camera share its rendering
    :param kwargs: parameters of :class:`CameraSensor`
    """

    def __init__(self, scene: Scene, shadow: bool = True, **kwargs: Any) -> None:
        super().__init__(scene, **kwargs)
        shadow = checks.check_argument("shadow", shadow, checks.boolean)
        self._mounted = replace(self._mounted, shadow=shadow)

    @property
    def space(self) -> spaces.Box:
        """Red, green and blue, (3, height, width)."""
        return spaces.Box(0, 255, (3, self._mounted.height, self._mounted.width), np.uint8)

    def read(self, view: View) -> NDArray[np.uint8]:
        """Return the image."""
        camera = self.camera
        image = camera.color(self.scene.world) if camera.shadow else view.images(camera)[0]
        return np.ascontiguousarray(image.transpose(2, 0, 1))


class Depth(CameraSensor):
    """Depth image of a camera."""

    @property
    def space(self) -> spaces.Box:
        """Metres along the optical axis, (1, height, width)."""
        camera = self._mounted
        return spaces.Box(0.0, camera.far, (1, camera.height, camera.width), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return the distances (m)."""
        camera = replace(self.camera, shadow=False)
        distances = view.images(camera)[1]
        measured = view.measure(distances, camera) if view.measure else distances
        return measured[None].clip(0.0, camera.far)


class PointCloud(Sensor):
    """Points that two depth cameras at the workspace's sides measure (paper, Close-loop Environments).

    Points on the arm and the ground plane, outside the square of the heightmap and, in open loop, on the
    grasped object are removed. The rest is sampled at even steps, camera by camera and row by row, with
    repetitions if there are fewer points than requested. Without a point the reading is zeros.

    :param points: number of points
    """

    def __init__(self, scene: Scene, points: int = 1024) -> None:
        super().__init__(scene)
        self._count = checks.check_argument("points", points, checks.integer(1, 65536))
        self._cameras = side_cameras(scene.config, pixels=128)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The two cameras, the lower y first."""
        return {f"_{number}": camera for number, camera in enumerate(self._cameras)}

    @property
    def space(self) -> spaces.Box:
        """Metres, (points, 3)."""
        return spaces.Box(-np.inf, np.inf, (self._count, 3), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        """Return points along the world's axes, relative to the origin of the view's frame.

        The origin is at the fingertips or, in open loop, at the centre of the workspace's floor.
        """
        world, robot, frame = self.scene.world, self.scene.robot, view.frame
        grasped = [robot.held] if frame.hides_grasped and robot.held is not None else []
        hidden = [robot.body, world.ground, *grasped]
        points = np.concatenate([camera.points(world, hidden, view.measure) for camera in self._cameras])
        points -= frame.origin.position
        points = points[(np.abs(points[:, :2]) <= frame.extent / 2.0).all(axis=1)]
        reading = np.zeros((self._count, 3), np.float32)
        if len(points):
            reading[:] = points[np.linspace(0, len(points) - 1, self._count).round().astype(np.int64)]
        return reading
