"""Cameras that render without a display, and the camera, keys and lines of PyBullet's window."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Vector
from bulletarm_gym.simulation.state import NOMINAL, Body
from bulletarm_gym.simulation.world import World

LIGHT = (0.6, -0.9, 1.6)
"""Direction to the light (world)."""
LIGHT_DISTANCE = 3.0
"""Distance (m) of the light from the world's origin, from which its shadow map covers arm and workspace.

Bullet renders the map with the camera's projection, and extends shadows at its border without limit.
"""
VERTICAL = 1e-3
"""Slope from the vertical (m per metre) below which the optical axis is vertical."""
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transformation (4, 4) from the camera frame to that of OpenGL: x right, y up, z backward."""

Measure = Callable[..., Any]
"""Function of distances (height, width; m) and a camera that returns the measured distances."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels and the centre of its image on the optical axis.

    :param eye: position (m, world)
    :param target: a point on the optical axis (m, world)
    :param fov: vertical field of view (degrees)
    :param width: width of the image (pixels)
    :param height: height of the image (pixels)
    :param near: smallest visible distance (m)
    :param far: largest visible distance (m)
    :param up: upward direction of the image in the world; by default z, or -x if the camera looks straight
        down, so that rows grow with world x and columns with y
    :param shadow: render shadows in color images, which takes more than twice the time
    """

    eye: Vector = (1.4, -0.95, 0.95)
    target: Vector = (0.27, 0.0, 0.33)
    fov: float = 42.0
    width: int = 480
    height: int = 480
    near: float = 0.05
    far: float = 4.0
    up: Vector | None = None
    shadow: bool = True

    @property
    def intrinsics(self) -> FloatArray:
        """Camera matrix (3, 3) in pixels: it maps (x, y, z) of the camera frame to (column, row, 1) times z.

        The centre of a pixel has integer coordinates, the first pixel (0, 0).
        """
        focal = self.height / (2.0 * math.tan(math.radians(self.fov) / 2.0))
        middle = (self.width - 1) / 2.0, (self.height - 1) / 2.0
        return np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])

    @property
    def extrinsics(self) -> FloatArray:
        """Transformation (4, 4) from the world to the camera frame (m): x right, y down, z forward."""
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self._up)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = right, np.cross(forward, right), forward
        matrix[:3, 3] = -matrix[:3, :3] @ self.eye
        return matrix

    def color(self, world: World) -> NDArray[np.uint8]:
        """Return the color image, (height, width, 3)."""
        return self._render(world, self.shadow)[0]

    def color_and_depth(self, world: World) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the color image without shadows and the distances (m) of one rendering."""
        colors, distances, _ = self._render(world)
        return colors, distances.astype(np.float32)

    def depth(self, world: World) -> NDArray[np.float32]:
        """Return distances (m) along the optical axis, (height, width)."""
        return self.color_and_depth(world)[1]

    def points(self, world: World, without: Sequence[Body], measure: Measure | None = None) -> FloatArray:
        """Return the visible points (n, 3; m, world) as measured, without the points on some bodies."""
        _, distances, shown = self._render(world)
        distances = distances if measure is None else measure(distances, self)
        visible = ~np.isin(shown, [body.id for body in without]) & (distances < self.far * 0.99)
        rows, columns = np.nonzero(visible)
        pixels = np.stack([columns, rows, np.ones(len(rows))])
        to_rays: Any = np.linalg.inv(self.intrinsics)
        offsets = to_rays @ pixels * distances[rows, columns]
        points: FloatArray = np.asarray(self.eye) + offsets.T @ self.extrinsics[:3, :3]
        return points

    def project(self, point: Vector) -> tuple[float, float]:
        """Return the column and row (pixels) of a point (m, world)."""
        column, row, scale = self.intrinsics @ (self.extrinsics @ [*point, 1.0])[:3]
        return float(column / scale), float(row / scale)

    @property
    def _up(self) -> Vector:
        if self.up is not None:
            return self.up
        across = math.hypot(self.eye[0] - self.target[0], self.eye[1] - self.target[1])
        return (0.0, 0.0, 1.0) if across > VERTICAL * abs(self.eye[2] - self.target[2]) else (-1.0, 0.0, 0.0)

    def _render(
        self, world: World, shadow: bool = False
    ) -> tuple[NDArray[np.uint8], FloatArray, NDArray[np.int64]]:
        """Return colors, distances (m) and the number in Bullet of the visible body of each pixel."""
        client, optics = world.client, world.optics
        # TinyRenderer samples pixel (column, row) at (column, row + 1) of an image whose first pixel spans 0
        # to 1. A shift by half a pixel makes it sample the centre of each pixel.
        aspect = self.width / self.height
        projection = list(client.computeProjectionMatrixFOV(self.fov, aspect, self.near, self.far))
        projection[8] += 1.0 / self.width
        projection[9] += 1.0 / self.height
        view, light = client.computeViewMatrix(self.eye, self.target, self._up), {}
        if optics != NOMINAL:
            view = (OPENGL_AXES @ optics.camera_error @ self.extrinsics).T.ravel().tolist()
            light = {"lightColor": (optics.brightness,) * 3}
        _, _, pixels, buffer, shown = client.getCameraImage(
            self.width,
            self.height,
            view,
            projection,
            **light,
            lightDirection=[default + change for default, change in zip(LIGHT, optics.light, strict=True)],
            lightDistance=LIGHT_DISTANCE,
            shadow=int(shadow),
            renderer=client.ER_TINY_RENDERER,
        )
        shape = self.height, self.width
        colors = np.asarray(pixels, np.uint8).reshape(*shape, 4)[:, :, :3].copy()
        nearness = np.asarray(buffer, np.float64).reshape(shape)
        distances = self.far * self.near / (self.far - (self.far - self.near) * nearness)
        return colors, distances, np.asarray(shown).reshape(shape)


def look(world: World, eye: Vector, target: Vector) -> None:
    """Set the camera of the window to a position and a target (m), and hide the panels."""
    client = world.client
    across, along, up = (a - b for a, b in zip(eye, target, strict=True))
    distance = math.dist(eye, target)
    yaw, pitch = math.degrees(math.atan2(across, -along)), math.degrees(math.asin(up / distance))
    client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
    client.resetDebugVisualizerCamera(distance, yaw, -pitch, target)


class Keyboard:
    """Keys of a window. PyBullet's own shortcuts are switched off.

    For a key that was pressed and released between two calls, PyBullet reports the release only.
    """

    def __init__(self, world: World) -> None:
        self._client = world.client
        self._client.configureDebugVisualizer(self._client.COV_ENABLE_KEYBOARD_SHORTCUTS, 0)
        self._down: set[int] = set()

    def pressed(self) -> list[str]:
        """Return the characters of the keys pressed since the last call; empty without a window."""
        events = self._client.getKeyboardEvents()
        triggered = {key for key, event in events.items() if event & self._client.KEY_WAS_TRIGGERED}
        released = {key for key, event in events.items() if event & self._client.KEY_WAS_RELEASED}
        pressed = sorted(triggered | (released - self._down))
        self._down = (self._down | set(events)) - released
        return [chr(key) for key in pressed if chr(key).isascii() and chr(key).isprintable()]


def draw_segments(
    world: World, segments: Sequence[tuple[Vector, Vector]], replaced: Sequence[int] = ()
) -> list[int]:
    """Draw orange lines between points (m, world) in place of earlier ones, and return their numbers."""
    options = [{"replaceItemUniqueId": item} for item in replaced] or [{}] * len(segments)
    return [
        world.client.addUserDebugLine(start, end, (1.0, 0.35, 0.2), 3.0, **option)
        for (start, end), option in zip(segments, options, strict=True)
    ]
