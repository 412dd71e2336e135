"""Heightmaps of a scene from straight above, and the view that all sensors and the control share."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import ORTHOGRAPHIC
from bulletarm_gym.config_checks import check_fields, instance, numbers
from bulletarm_gym.geometry import FloatArray, Pose, Rectangle, matrix
from bulletarm_gym.observations.cameras import SIDE_HEIGHT, SIDE_PIXELS, side_cameras
from bulletarm_gym.observations.rasterizer import Labels, Window, ZBuffer, project_points, rectangle_mask
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Body, Camera
from bulletarm_gym.simulation.camera import Measure
from bulletarm_gym.simulation.state import NOMINAL, Optics

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

    def __post_init__(self) -> None:
        check_fields(self, {"rectangle": instance(Rectangle), "rise": numbers()})


@dataclass(frozen=True)
class ElevationMap:
    """Heights over a square of the world.

    :param heights: (n, n) m; rows grow with world x, columns with y
    :param centre: world x and y (m) of the square's centre
    :param extent: side of the square (m)
    :param floor: world z (m) from which the heights are measured
    """

    heights: Heights
    centre: tuple[float, float]
    extent: float
    floor: float = 0.0

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


class HeightRenderer:
    """Renderer of heightmaps, without the arm; :meth:`of` returns the one of a scene."""

    def __init__(self, scene: Scene) -> None:
        self._world, self._config, self._arm = scene.world, scene.config, scene.robot.body
        visible = self._world.visible
        self.bodies: list[Body] = [body for body in visible for _ in body.spec.part_meshes]
        """Body of each rendered mesh; a body with moving parts has one mesh a part."""
        self.draw = ZBuffer([mesh for body in visible for mesh in body.spec.part_meshes]).draw
        self._owners = np.array([body.index for body in self.bodies], np.int64)
        self._marks = np.array([body.spec.is_mark for body in self.bodies], np.bool_)
        rows = np.searchsorted(self._owners, [body.index for body in visible]).tolist()
        self._first_rows = list(zip(visible, rows, strict=True))
        self._positions = np.zeros((len(self.bodies), 3))
        self._rotations = np.zeros((len(self.bodies), 3, 3))

    @classmethod
    def of(cls, scene: Scene) -> "HeightRenderer":
        """Return the renderer of a scene."""
        return scene.cached(cls)

    def heights(
        self, window: Window, without: Body | None = None, measure: Measure | None = None
    ) -> NDArray[np.float32]:
        """Return the height (m) of the highest surface over each pixel, (size, size), in the configured view.

        :param without: body that the orthographic view omits
        :param measure: errors of the cameras, by default none
        """
        if self._config.view == ORTHOGRAPHIC:
            heights = self._draw(self._present(without) & ~self._marks, window, optics=self._world.optics)
            return heights if measure is None else SIDE_HEIGHT - measure(SIDE_HEIGHT - heights)
        cameras = side_cameras(self._config, SIDE_PIXELS)
        cloud = np.concatenate([camera.points(self._world, [self._arm], measure) for camera in cameras])
        return project_points(cloud, window, self._config.workspace[2][1])

    def heights_of(
        self, bodies: Sequence[Body], window: Window, labels: Labels | None = None
    ) -> NDArray[np.float32]:
        """Return orthographic heights as :meth:`heights` of some bodies alone, 0 where there is none.

        :param labels: (size, size), in which the values of :meth:`labels` are set where such a body is
        """
        wanted = np.zeros(len(self._world.bodies), np.bool_)
        wanted[[body.index for body in bodies]] = True
        return self._draw(self._present() & wanted[self._owners], window, labels)

    def labels(self, window: Window, without: Body | None = None) -> Labels:
        """Return 1 + the index in :attr:`bodies` of the highest mesh of each pixel, (size, size).

        It is 0 where no mesh is. Marks on the ground are below all other meshes.
        """
        labels = np.zeros((window.size, window.size), np.int16)
        for layer in (self._marks, ~self._marks):
            self._draw(self._present(without) & layer, window, labels, self._world.optics)
        return labels

    def _present(self, without: Body | None = None) -> NDArray[np.bool_]:
        """Return a mask of the meshes in the scene."""
        present: NDArray[np.bool_] = np.array(self._world.active, np.bool_)[self._owners]
        return present if without is None else present & (self._owners != without.index)

    def _draw(
        self,
        visible: NDArray[np.bool_],
        window: Window,
        labels: Labels | None = None,
        optics: Optics = NOMINAL,
    ) -> NDArray[np.float32]:
        for body, row in self._first_rows:
            if self._world.active[body.index]:
                for index, part in enumerate(self._world.part_poses(body), row):
                    self._positions[index], self._rotations[index] = part.position, matrix(part)
        positions, rotations = self._positions, self._rotations
        if not any(optics.position + optics.rotation):
            return self.draw(positions, rotations, visible, window, labels)
        rotation, (x, y, z) = matrix(Pose.planar(0.0, 0.0, 0.0, optics.rotation[2])), optics.position
        positions = (positions - (*window.centre, 0.0)) @ rotation.T
        shifted = window._replace(centre=(-x, -y))
        return self.draw(positions, rotation @ rotations, visible, shifted, labels) + np.float32(z)


class View:
    """View of the scene from straight above, rendered once at first access.

    It must be accessed before the scene changes. ``measure`` adds the errors of depth cameras.
    """

    def __init__(
        self, scene: Scene, frame: Frame, overlays: Sequence[Overlay], measure: Measure | None
    ) -> None:
        self._scene = scene
        self.measure = measure
        self.frame = frame
        self.window = Window(frame.centre, frame.extent, scene.config.obs_size)
        self.overlays = tuple(overlays)
        self._moment = self._present()
        self._images: dict[Camera, tuple[NDArray[np.uint8], NDArray[np.float32]]] = {}

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
        return HeightRenderer.of(self._scene).heights(self.window, self._hidden, self.measure)

    @cached_property
    def labels(self) -> Labels:
        """Number of the visible mesh of each pixel, (size, size), see :meth:`HeightRenderer.labels`."""
        if not self.is_current:
            raise RuntimeError("labels must be read before the scene changes")
        return HeightRenderer.of(self._scene).labels(self.window, self._hidden)

    def images(self, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the color image without shadows and the distances (m) of a camera, rendered once."""
        if camera not in self._images:
            self._images[camera] = camera.color_and_depth(self._scene.world)
        return self._images[camera]

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
        return ElevationMap(heights, self.frame.centre, self.frame.extent, self.frame.origin.z)


def measure(scene: Scene) -> dict[str, float]:
    """Return a dict that counts the seconds of simulation steps and heightmaps from now on."""
    seconds = {"physics": 0.0, "rendering": 0.0}

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            start = time.perf_counter()
            result = function(*args, **options)
            seconds[part] += time.perf_counter() - start
            return result

        return call

    renderer = HeightRenderer.of(scene)
    scene.world.wrap_step(partial(timed, "physics"))
    renderer.draw = timed("rendering", renderer.draw)
    return seconds
