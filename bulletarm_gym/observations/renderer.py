"""Heightmaps of a scene."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import ORTHOGRAPHIC
from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.observations.cameras import SIDE_PIXELS, side_cameras
from bulletarm_gym.observations.rasterizer import Labels, Window, ZBuffer, project_points
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Body
from bulletarm_gym.simulation.shapes import Colour


class HeightRenderer:
    """Renderer of heightmaps, without the arm; :meth:`of` returns the one of a scene.

    :param scene: scene with all bodies loaded
    """

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
        self._posed: list[Pose | None] = [None] * len(visible)
        self._positions = np.zeros((len(self.bodies), 3))
        self._orientations = np.zeros((len(self.bodies), 4))

    @classmethod
    def of(cls, scene: Scene) -> "HeightRenderer":
        """Return the renderer of a scene."""
        return scene.cached(cls)

    def heights(self, window: Window, without: Body | None = None) -> NDArray[np.float32]:
        """Return the height (m) of the highest surface over each pixel, (size, size), in the configured view.

        :param without: body that the orthographic view omits
        """
        if self._config.view == ORTHOGRAPHIC:
            return self._draw(self._present(without) & ~self._marks, window)
        cameras = side_cameras(self._config, SIDE_PIXELS)
        cloud = np.concatenate([camera.points(self._world, [self._arm]) for camera in cameras])
        return project_points(cloud, window, self._config.workspace[2][1])

    def heights_of(self, bodies: Sequence[Body], window: Window) -> NDArray[np.float32]:
        """Return orthographic heights as :meth:`heights` of some bodies alone, 0 where there is none."""
        wanted = np.zeros(len(self._world.bodies), np.bool_)
        wanted[[body.index for body in bodies]] = True
        return self._draw(self._present() & wanted[self._owners], window)

    def labels(self, window: Window, without: Body | None = None) -> Labels:
        """Return 1 + the index in :attr:`bodies` of the highest mesh of each pixel, (size, size).

        It is 0 where no mesh is. Marks on the ground are below all other meshes.
        """
        labels = np.zeros((window.size, window.size), np.int16)
        for layer in (self._marks, ~self._marks):
            self._draw(self._present(without) & layer, window, labels)
        return labels

    @property
    def colours(self) -> list[Colour]:
        """Present colour of each rendered mesh."""
        return [
            colour
            for body in self._world.visible
            for colour in (self._world.get_properties(body).colour, *body.spec.part_colours[1:])
        ]

    def _present(self, without: Body | None = None) -> NDArray[np.bool_]:
        """Return a mask of the meshes in the scene."""
        present: NDArray[np.bool_] = np.array(self._world.active, np.bool_)[self._owners]
        return present if without is None else present & (self._owners != without.index)

    def _draw(
        self, visible: NDArray[np.bool_], window: Window, labels: Labels | None = None
    ) -> NDArray[np.float32]:
        return self.draw(*self._poses(), visible, window, labels)

    def _poses(self) -> tuple[FloatArray, FloatArray]:
        """Return positions (n, 3) and orientations (n, 4) of the meshes; poses that are the same are kept."""
        for number, (body, row) in enumerate(self._first_rows):
            pose = self._world.poses[body.index]
            if pose is self._posed[number] and not body.joints:
                continue
            self._posed[number] = pose
            for index, part in enumerate(self._world.part_poses(body), row):
                self._positions[index], self._orientations[index] = part.position, part.orientation
        return self._positions, self._orientations


def measure(scene: Scene) -> dict[str, float]:
    """Return a dict whose values grow by the seconds of simulation steps and of heightmaps from now on.

    Its keys are ``"physics"`` and ``"rendering"``.
    """
    seconds = {"physics": 0.0, "rendering": 0.0}
    renderer = HeightRenderer.of(scene)
    scene.world.wrap_step(partial(partial, _timed, seconds, "physics"))
    renderer.draw = partial(_timed, seconds, "rendering", renderer.draw)
    return seconds


def _timed(
    seconds: dict[str, float], part: str, function: Callable[..., Any], *args: Any, **options: Any
) -> Any:
    """Call a function and add its duration to a part."""
    start = time.perf_counter()
    try:
        return function(*args, **options)
    finally:
        seconds[part] += time.perf_counter() - start
