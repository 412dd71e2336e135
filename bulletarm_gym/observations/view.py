"""View of the scene from straight above, which all sensors and the control share."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Pose, Rectangle
from bulletarm_gym.observations.rasterizer import Labels, Window, rectangle_mask
from bulletarm_gym.observations.renderer import HeightRenderer
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Body

MAX_HEIGHT = 0.4
"""Largest value (m) of a heightmap or in-hand image."""

Heights = NDArray[np.float32]


@dataclass(frozen=True)
class Overlay:
    """Rectangle that the heightmap shows nearer to the camera than the surface below.

    :param rectangle: rectangle in the world
    :param rise: distance (m) by which it is nearer
    """

    rectangle: Rectangle
    rise: float


@dataclass(frozen=True)
class ElevationMap:
    """Heights over a square of the world.

    :param heights: (n, n) m; rows grow with world x, columns with y
    :param centre: world x and y (m) of the square's centre
    :param extent: side of the square (m)
    """

    heights: Heights
    centre: tuple[float, float]
    extent: float

    @property
    def window(self) -> Window:
        """The square."""
        return Window(self.centre, self.extent, len(self.heights))

    @property
    def resolution(self) -> float:
        """Side (m) of a pixel."""
        return self.extent / len(self.heights)

    def pixels(self, points: FloatArray) -> FloatArray:
        """Return rows and columns of points (..., 2 or more; m); integers are the centres of pixels."""
        corner = np.array(self.centre) - self.extent / 2.0
        return (points[..., :2] - corner) / self.resolution - 0.5

    def points(self, pixels: NDArray[np.int64]) -> FloatArray:
        """Return world x and y (m) of the centres of pixels, (..., 2); the inverse of :meth:`pixels`."""
        corner = np.array(self.centre) - self.extent / 2.0
        found: FloatArray = (pixels + 0.5) * self.resolution + corner
        return found


@dataclass(frozen=True)
class Frame:
    """Square that a control shows to the agent.

    :param origin: centre of the square in the world (m), origin of positions in observations
    :param extent: side of the square (m)
    :param plane: height (m) of the camera plane of a depth image; None for heights above the origin
    :param fingers: squares that represent the fingers
    :param hides_grasped: whether the grasped object is not rendered
    """

    origin: Pose
    extent: float
    plane: float | None = None
    fingers: tuple[Rectangle, ...] = ()
    hides_grasped: bool = False

    @property
    def centre(self) -> tuple[float, float]:
        """World x and y (m) of the square's centre."""
        return (self.origin.x, self.origin.y)


class View:
    """View of the scene from straight above, rendered once at first access.

    It must be accessed before the scene changes.

    :param scene: scene that is shown
    :param frame: square that is shown
    :param overlays: overlays of the heightmap
    """

    def __init__(self, scene: Scene, frame: Frame, overlays: Sequence[Overlay] = ()) -> None:
        self._scene = scene
        self.frame = frame
        self.window = Window(frame.centre, frame.extent, scene.config.obs_size)
        self.overlays = tuple(overlays)
        self._moment = self._present()

    @property
    def is_current(self) -> bool:
        """Return True if no body has moved since."""
        return self._present() == self._moment

    def _present(self) -> tuple[object, ...]:
        world = self._scene.world
        return (tuple(world.poses), tuple(world.joints), tuple(world.active), self._scene.robot.held)

    @property
    def is_holding(self) -> bool:
        """Return True if the gripper holds an object."""
        return self._scene.robot.held is not None

    @cached_property
    def heights(self) -> Heights:
        """Heights (m), (size, size), above the world's z = 0; read-only."""
        return HeightRenderer.of(self._scene).heights(self.window, self._hidden)

    @cached_property
    def labels(self) -> Labels:
        """Number of the visible mesh of each pixel, (size, size), see :meth:`HeightRenderer.labels`.

        :raises RuntimeError: a body has moved since
        """
        if not self.is_current:
            raise RuntimeError("labels must be read before the scene changes")
        return HeightRenderer.of(self._scene).labels(self.window, self._hidden)

    @property
    def _hidden(self) -> Body | None:
        return self._scene.robot.held if self.frame.hides_grasped else None

    @cached_property
    def fingers(self) -> NDArray[np.bool_]:
        """Mask of the squares that represent the fingers, (size, size)."""
        return rectangle_mask(self.window, self.frame.fingers)

    @cached_property
    def elevation_map(self) -> ElevationMap:
        """Heights (m) above the frame's origin, within [0, 0.4], without overlays; read-only."""
        heights = (self.heights - np.float32(self.frame.origin.z)).clip(0.0, MAX_HEIGHT)
        return ElevationMap(heights, self.frame.centre, self.frame.extent)
