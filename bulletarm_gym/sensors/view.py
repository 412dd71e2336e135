"""What sensors look at: the scene at one moment, seen from straight above."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Pose, Rectangle
from bulletarm_gym.rendering.overlays import Overlay, rectangle_mask
from bulletarm_gym.rendering.rasterizer import Labels
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Body

MAX_HEIGHT = 0.4
"""Largest value (m) of a heightmap or depth image."""

Heights = NDArray[np.float32]


@dataclass(frozen=True)
class Map:
    """Heights over a square of the world.

    :param heights: (n, n) m; rows grow with world x, columns with y
    :param centre: world x and y (m) of its middle
    :param extent: its side (m)
    """

    heights: Heights
    centre: tuple[float, float]
    extent: float

    @property
    def resolution(self) -> float:
        """Side (m) of a pixel."""
        return self.extent / len(self.heights)

    def pixels(self, points: FloatArray) -> FloatArray:
        """Return where points (..., 2 or more; m) are in rows and columns; pixel 0 has its middle at 0."""
        corner = np.array(self.centre) - self.extent / 2.0
        return (points[..., :2] - corner) / self.resolution - 0.5

    def points(self, pixels: NDArray[np.int64]) -> FloatArray:
        """Return world x and y (m) of the middles of pixels, (..., 2); the inverse of :meth:`pixels`."""
        corner = np.array(self.centre) - self.extent / 2.0
        found: FloatArray = (pixels + 0.5) * self.resolution + corner
        return found


@dataclass(frozen=True)
class Frame:
    """The square that a control shows, and how it shows what is in it.

    :param origin: its middle, in the world (m): what is measured in the picture is measured from there
    :param extent: its side (m)
    :param plane: height (m) of the plane that depths are measured from, downwards; None shows heights above
        the origin
    :param fingers: what stands for the fingers
    :param hides_grasped: whether the grasped object is not drawn
    """

    origin: Pose
    extent: float
    plane: float | None = None
    fingers: tuple[Rectangle, ...] = ()
    hides_grasped: bool = False

    @property
    def centre(self) -> tuple[float, float]:
        """World x and y (m) of its middle."""
        return (self.origin.x, self.origin.y)


class View:
    """The scene at one moment, looked at from straight above; drawn once, when it is first asked for.

    It must be asked while the moment lasts.

    :param scene: what is looked at
    :param frame: which part of it
    :param overlays: what the heightmap shows besides bodies
    :param labelled: draw at once which part of the scene each pixel shows
    """

    def __init__(
        self,
        scene: Scene,
        frame: Frame,
        overlays: Callable[[Scene], tuple[Overlay, ...]],
        labelled: bool = False,
    ) -> None:
        self._scene = scene
        self.frame = frame
        self.size = scene.config.obs_size
        self._overlays = overlays
        self._labelled = labelled
        self._moment = self._present()

    @property
    def is_current(self) -> bool:
        """Whether everything still is where it was, so that another look would show the same."""
        return self._present() == self._moment

    def _present(self) -> tuple[object, ...]:
        world = self._scene.world
        return (tuple(world.poses), tuple(world.joints), tuple(world.active), self._scene.robot.held)

    @property
    def is_holding(self) -> bool:
        """Whether the gripper holds an object."""
        return self._scene.robot.held is not None

    @property
    def _hidden(self) -> Body | None:
        return self._scene.robot.held if self.frame.hides_grasped else None

    @property
    def overlays(self) -> tuple[Overlay, ...]:
        """What the heightmap shows besides bodies: a pushing goal."""
        return self._overlays(self._scene)

    @cached_property
    def heights(self) -> Heights:
        """Heights (m) of what is seen, (size, size), above the world's z = 0; not to be changed."""
        if self._labelled:
            return self._both[0]
        frame = self.frame
        return self._scene.heights(frame.centre, frame.extent, self.size, self._hidden)

    @property
    def labels(self) -> Labels:
        """Which part is seen, (size, size), see :meth:`~bulletarm_gym.scene.Scene.labelled`."""
        return self._both[1]

    @cached_property
    def _both(self) -> tuple[Heights, Labels]:
        frame = self.frame
        return self._scene.labelled(frame.centre, frame.extent, self.size, self._hidden)

    @cached_property
    def fingers(self) -> NDArray[np.bool_]:
        """Which pixels, (size, size), the squares that stand for the fingers cover."""
        frame = self.frame
        return rectangle_mask(frame.centre, frame.extent, self.size, frame.fingers)

    @cached_property
    def map(self) -> Map:
        """Heights (m) above the frame's origin, within [0, 0.4], without overlays; not to be changed."""
        frame = self.frame
        heights = (self.heights - np.float32(frame.origin.z)).clip(0.0, MAX_HEIGHT)
        return Map(heights, frame.centre, frame.extent)
