"""Default cameras, which look at the configured workspace, and the cameras of an environment by name."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import ParameterError
from bulletarm_gym.geometry import FloatArray, Vector
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera, World

RENDER = "render"
"""Name of the camera of ``render()``."""
OVERVIEW = ((0.95, -0.95, 0.95), (-0.18, 0.0, 0.33))
"""Position and target (m) of the camera of ``render()``, relative to the centre of a default workspace."""
SIZES = (0.3, 0.4)
"""Sides (m) of the default workspaces. Cameras are nearer to smaller ones, farther from larger ones."""
REACHES = (0.45, 0.65)
"""Distances (m) from the base of an arm to the workspace for which ``OVERVIEW`` shows both."""


@dataclass(frozen=True)
class SceneCamera:
    """A camera of an environment.

    :param camera: position, direction and size of its images
    :param world: what it measures
    """

    camera: Camera
    world: World

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


def sight(scene: Scene, eye: Vector, target: Vector, scale: float | None = None) -> tuple[Vector, Vector]:
    """Return the position and the target (m, world) of a camera that looks at the workspace.

    :param eye: position (m) relative to the centre of a default workspace that is in front of the arm
    :param target: target (m), relative to the same point
    :param scale: factor on both, by default the size of the workspace relative to the default ones
    """
    (x, y), base = scene.config.centre, scene.robot.model.base
    azimuth = math.atan2(y - base.y, x - base.x)
    cosine, sine = math.cos(azimuth), math.sin(azimuth)
    scale = _beyond(scene.config.workspace_size, SIZES) if scale is None else scale

    def place(offset: Vector) -> Vector:
        ahead, left, up = (scale * part for part in offset)
        return (x + cosine * ahead - sine * left, y + sine * ahead + cosine * left, up)

    return place(eye), place(target)


def aimed(position: Vector, target: Vector, fov: float, width: int, height: int) -> Camera:
    """Return a camera at a position (m) that looks at a target (m) and beyond it.

    :raises ValueError: position and target are the same point
    """
    if position == target:
        raise ValueError(f"target must be another point than position, got {list(target)}")
    far = max(Camera.far, 2.0 * math.dist(position, target))
    return Camera(position, target, fov, width, height, far=far)


def render_camera(scene: Scene) -> Camera:
    """Return the camera of ``render()``: the configured one, or one that shows arm and workspace.

    :raises ParameterError: the configured position and target are the same point
    """
    config, base = scene.config, scene.robot.model.base
    distance = math.dist(config.centre, (base.x, base.y))
    scale = max(_beyond(config.workspace_size, SIZES), _beyond(distance, REACHES))
    position, target = sight(scene, *OVERVIEW, scale)
    chosen: dict[str, Any] = {"position": position, "target": target, "fov": Camera.fov}
    chosen |= config.render_camera or {}
    try:
        position, target = tuple(chosen["position"]), tuple(chosen["target"])
        return aimed(position, target, chosen["fov"], *config.render_size)
    except ValueError as error:
        raise ParameterError(f"render_camera: {error}") from None


def scene_cameras(scene: Scene, others: Mapping[str, Camera]) -> dict[str, SceneCamera]:
    """Return the camera of ``render()`` and other cameras by their names."""
    cameras = {RENDER: render_camera(scene), **others}
    return {name: SceneCamera(camera, scene.world) for name, camera in cameras.items()}


def _beyond(value: float, limits: tuple[float, float]) -> float:
    """Return the factor by which a value is below or above limits, 1 between them."""
    return value / min(max(value, limits[0]), limits[1])


def render_frame(camera: SceneCamera, mode: str | None, env_id: str) -> Any:
    """Return an image (height, width, 3) uint8, distances (height, width) float32 in metres, or None.

    Without a mode, a warning says so, as in Gymnasium's environments.
    """
    if mode == "rgb_array":
        return camera.color()
    if mode == "depth_array":
        return camera.depth()
    if mode is None:
        advice = f'Use gymnasium.make("{env_id}", render_mode="rgb_array").'
        gymnasium.logger.warn(f"render_mode must be set for render(), got None. {advice}")
    return None
