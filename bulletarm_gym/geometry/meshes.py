"""Triangle meshes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry.poses import FloatArray, IntArray, Pose


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the frame of the link that carries it.

    :param vertices: (V, 3) float64, metres
    :param faces: (F, 3) int32, counter-clockwise seen from outside
    """

    vertices: FloatArray
    faces: IntArray

    @classmethod
    def of(cls, vertices: ArrayLike, faces: ArrayLike) -> "Mesh":
        """Build a mesh from array-likes."""
        return cls(
            np.ascontiguousarray(vertices, dtype=np.float64).reshape(-1, 3),
            np.ascontiguousarray(faces, dtype=np.int32).reshape(-1, 3),
        )

    @classmethod
    def box(cls, extents: Sequence[float], centre: Sequence[float] = (0.0, 0.0, 0.0)) -> "Mesh":
        """Build an axis-aligned box of full side lengths ``extents`` (m)."""
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return cls.of(corners * np.asarray(extents) + np.asarray(centre), _BOX_FACES)

    def moved(self, pose: Pose) -> "Mesh":
        """Return the mesh in the outer frame of ``pose``."""
        points = [pose.transform((v[0], v[1], v[2])) for v in self.vertices.tolist()]
        return Mesh.of(points, self.faces)

    @cached_property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner, (2, 3) metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh that holds the triangles of all."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = [m.faces + int(offset) for m, offset in zip(meshes, offsets, strict=True)]
    return Mesh.of(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))


_BOX_FACES = (
    (0, 1, 3), (0, 3, 2),  # x low
    (4, 6, 7), (4, 7, 5),  # x high
    (0, 4, 5), (0, 5, 1),  # y low
    (2, 3, 7), (2, 7, 6),  # y high
    (0, 2, 6), (0, 6, 4),  # z low
    (1, 5, 7), (1, 7, 3),  # z high
)  # fmt: skip
