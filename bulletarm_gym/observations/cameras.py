"""Default cameras, which show the configured workspace, cameras by name, and the window of an environment."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import EnvConfig, ParameterError
from bulletarm_gym.geometry import FloatArray, Pose, Vector
from bulletarm_gym.geometry.poses import scaled
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera, World
from bulletarm_gym.simulation.camera import Keyboard, draw_segments, look

RENDER = "render"
"""Name of the camera of ``render()``."""
OVERVIEW = ((0.95, -0.95, 0.95), (-0.18, 0.0, 0.33))
"""Position and target (m) of the camera of ``render()``, relative to the centre of a default workspace."""
PIXELS = 240
"""Default pixels a side of close-ups."""
SIZES = (0.3, 0.4)
"""Sides (m) of the default workspaces. Camera distances scale with smaller and larger ones."""
REACHES = (0.45, 0.65)
"""Distances (m) from the base of an arm to the workspace for which ``OVERVIEW`` shows both."""
SIDE_DISTANCE = 0.5
"""Horizontal distance (m) of the side cameras from the workspace's centre."""
SIDE_HEIGHT = 1.0
"""Height (m) of the side cameras."""
SIDE_FOV = 35.6
"""Field of view (degrees) of the side cameras."""
SIDE_PIXELS = 512
"""Pixels a side of the images of the side cameras in the point-cloud view."""


@dataclass(frozen=True)
class SceneCamera:
    """Camera of an environment; ``look`` returns it at present."""

    look: Callable[[], Camera]
    world: World

    @property
    def camera(self) -> Camera:
        """Position, direction and image size at present."""
        return self.look()

    @property
    def intrinsics(self) -> FloatArray:
        """Camera matrix (3, 3) in pixels; the centre of a pixel has integer coordinates."""
        return self.camera.intrinsics

    @property
    def extrinsics(self) -> FloatArray:
        """Transformation (4, 4) from the world to the camera frame (m): x right, y down, z forward."""
        return self.camera.extrinsics

    def color(self) -> NDArray[np.uint8]:
        """Return an image, (height, width, 3)."""
        return self.camera.color(self.world)

    def depth(self) -> NDArray[np.float32]:
        """Return distances (m) along the optical axis, (height, width)."""
        return self.camera.depth(self.world)

    def render(self, mode: str | None, env_id: str) -> Any:
        """Return what ``render()`` of an environment returns in a render mode.

        Without a mode a warning is logged, as in Gymnasium's environments.
        """
        if mode is None:
            advice = f'Use gymnasium.make("{env_id}", render_mode="rgb_array").'
            gymnasium.logger.warn(f"render_mode must be set for render(), got None. {advice}")
        images = {"rgb_array": self.color, "depth_array": self.depth}
        return images[mode]() if mode in images else None


def viewpoint(scene: Scene, eye: Vector, target: Vector, scale: float | None = None) -> tuple[Vector, Vector]:
    """Return the position and the target (m, world) of a camera that shows the workspace.

    :param eye: position (m) relative to the centre of a default workspace that is in front of the arm
    :param target: target (m), relative to the same point
    :param scale: factor on both, by default the size of the workspace relative to the default ones
    """
    (x, y), base = scene.config.centre, scene.robot.model.base
    frame = Pose.planar(x, y, 0.0, math.atan2(y - base.y, x - base.x))
    factor = _beyond(scene.config.workspace_size, SIZES) if scale is None else scale
    position, centre = (frame.transform(scaled(point, factor)) for point in (eye, target))
    return position, centre


def look_at(position: Vector, target: Vector, fov: float, size: Sequence[int]) -> Camera:
    """Return a camera at a position (m) whose optical axis leads through a target (m).

    :param size: width and height of the image (pixels)
    :raises ValueError: position and target are the same point
    """
    if position == target:
        raise ValueError(f"target must be another point than position, got {list(target)}")
    (width, height), far = size, max(Camera.far, 2.0 * math.dist(position, target))
    return Camera(position, target, fov, width, height, far=far)


def side_cameras(config: EnvConfig, pixels: int) -> tuple[Camera, Camera]:
    """Return the two cameras at the workspace's sides, the lower y first (paper, Close-loop Environments)."""
    x, y = config.centre
    scale = max(1.0, config.workspace_size / SIZES[1])
    eyes = [(x, y + side * scale, SIDE_HEIGHT * scale) for side in (-SIDE_DISTANCE, SIDE_DISTANCE)]
    first, second = (Camera(eye, (x, y, 0.0), SIDE_FOV, pixels, pixels, 0.1, 3.0 * scale) for eye in eyes)
    return first, second


def render_camera(scene: Scene) -> Camera:
    """Return the camera of ``render()``: the configured one, or one that shows arm and workspace."""
    config, base = scene.config, scene.robot.model.base
    distance = math.dist(config.centre, (base.x, base.y))
    scale = max(_beyond(config.workspace_size, SIZES), _beyond(distance, REACHES))
    position, target = viewpoint(scene, *OVERVIEW, scale)
    chosen = {"position": position, "target": target, "fov": Camera.fov, **(config.render_camera or {})}
    try:
        return look_at(tuple(chosen["position"]), tuple(chosen["target"]), chosen["fov"], config.render_size)
    except ValueError as error:
        raise ParameterError(f"render_camera: {error}") from None


def close_up_camera(scene: Scene, pixels: int) -> Camera:
    """Return a camera that shows the workspace from the front and above."""
    return Camera(*viewpoint(scene, (0.56, -0.4, 0.62), (0.0, 0.0, 0.03)), 32.0, pixels, pixels)


def _beyond(value: float, limits: tuple[float, float]) -> float:
    """Return the factor by which a value is below or above limits, 1 between them."""
    return value / min(max(value, limits[0]), limits[1])


class Viewer:
    """Images and user input for playing."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._mark: list[int] = []

    def close_up(self, pixels: int = PIXELS) -> NDArray[np.uint8]:
        """Return an image of the workspace from the front and above, (pixels, pixels, 3)."""
        return close_up_camera(self._scene, pixels).color(self._scene.world)

    @contextmanager
    def record_images(self, render: Callable[[], Any]) -> Iterator[list[Any]]:
        """Collect an image every 0.2 s of the simulation in the growing list that the context yields."""
        images: list[Any] = []
        count = itertools.count(1)

        def recorded(step: Callable[..., Any]) -> Callable[..., Any]:
            def step_and_render() -> None:
                step()
                if next(count) % 48 == 0:
                    images.append(render())

            return step_and_render

        restore = self._scene.world.wrap_step(recorded)
        try:
            yield images
        finally:
            restore()

    def face_workspace(self) -> None:
        """Show the workspace in the window, from the configured camera or from that of close-ups."""
        scene = self._scene
        camera = render_camera(scene) if scene.config.render_camera else close_up_camera(scene, PIXELS)
        look(scene.world, camera.eye, camera.target)

    def pressed_keys(self) -> list[str]:
        """Return the characters of the keys that were pressed in the window since the last call."""
        mode = self._scene.config.render_mode
        if mode != "human":
            raise RuntimeError(f"render_mode must be 'human' for pressed_keys(), got {mode!r}")
        return self._keyboard.pressed()

    @cached_property
    def _keyboard(self) -> Keyboard:
        return Keyboard(self._scene.world)

    def mark(self, position: Vector, yaw: float = 0.0) -> None:
        """Draw a target position (m, world) and yaw (rad) of the fingertips in the window."""
        x, y, z = position
        right, ahead = 0.04 * math.cos(yaw), 0.04 * math.sin(yaw)
        lines = [(position, (x, y, z + 0.3)), ((x - right, y - ahead, z), (x + right, y + ahead, z))]
        self._mark = draw_segments(self._scene.world, lines, self._mark)
