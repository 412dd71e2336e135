"""Poses of the meshes that are drawn, read from a world."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.simulation import Body, World


class MeshPoses:
    """Where the meshes that are seen from above are, one a body link; what has not moved is not written anew.

    :param world: sealed
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._owners = np.array(
            [body.index for body in world.visible for _ in body.spec.part_meshes], np.int64
        )
        rows = np.searchsorted(self._owners, [body.index for body in world.visible]).tolist()
        self._bodies = list(zip(world.visible, rows, strict=True))
        self._seen: list[Pose | None] = [None] * len(self._bodies)
        self._positions = np.zeros((len(self._owners), 3))
        self._orientations = np.zeros((len(self._owners), 4))

    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Return positions (n, 3) and orientations (n, 4); the next call may change them."""
        poses = self._world.poses
        for number, (body, row) in enumerate(self._bodies):
            pose = poses[body.index]
            if pose is self._seen[number] and not body.joints:
                continue
            self._seen[number] = pose
            for place, part in enumerate(self._world.part_poses(body), row):
                self._positions[place], self._orientations[place] = part.position, part.orientation
        return self._positions, self._orientations

    @property
    def present(self) -> NDArray[np.bool_]:
        """Which of the meshes, (n,), take part."""
        return np.array(self._world.active, np.bool_)[self._owners]

    def of(self, bodies: Sequence[Body]) -> NDArray[np.bool_]:
        """Return which of the meshes, (n,), are those of some bodies."""
        wanted = np.zeros(len(self._world.bodies), np.bool_)
        for body in bodies:
            wanted[body.index] = True
        return wanted[self._owners]
