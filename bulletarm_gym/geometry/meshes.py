"""Triangle meshes and the inertia of solids made of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry.poses import FloatArray, IntArray, Pose, Vector, quaternion


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    :param vertices: (V, 3) float64, metres
    :param faces: (F, 3) int32, counter-clockwise when viewed from outside
    """

    vertices: FloatArray
    faces: IntArray

    @classmethod
    def of(cls, vertices: ArrayLike, faces: ArrayLike) -> "Mesh":
        """Build a mesh from copies of array-likes.

        :raises ValueError: a vertex is not finite, or a face has a vertex that does not exist
        """
        points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
        corners = np.array(faces, dtype=np.int32).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise ValueError("vertices must be finite numbers, got NaN or infinity")
        if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
            got = f"{corners.min()} to {corners.max()}"
            raise ValueError(f"faces must be indices of {len(points)} vertices, from 0 on, got {got}")
        return cls(points, corners)

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
        """Lowest and highest corner (2, 3) of the bounding box, metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh with the triangles of all meshes."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = [m.faces + int(offset) for m, offset in zip(meshes, offsets, strict=True)]
    return Mesh.of(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))


def mass_properties(meshes: Sequence[Mesh], mass: float) -> tuple[Pose, Vector]:
    """Return the principal frame at the centre of mass and the inertia (kg m^2) about its axes.

    :param meshes: closed meshes with outward faces; overlapping volumes count twice
    :param mass: total mass (kg), uniformly distributed
    :raises ValueError: the meshes enclose no volume
    """
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    jacobians = np.transpose(corners, (0, 2, 1))
    six_volumes = np.linalg.det(jacobians)
    volume = six_volumes.sum() / 6.0
    if volume <= 0.0:
        raise ValueError("meshes must be closed with outward faces, got an enclosed volume of 0 or less")
    centre = (six_volumes[:, None] * corners.sum(axis=1)).sum(axis=0) / (24.0 * volume)
    unit = (np.ones((3, 3)) + np.eye(3)) / 120.0  # of the tetrahedron between origin and unit vectors
    moments = np.einsum("n,nij,jk,nlk->il", six_volumes, jacobians, unit, jacobians)
    covariance = (moments / volume - np.outer(centre, centre)) * mass
    values, axes = np.linalg.eigh(np.trace(covariance) * np.eye(3) - covariance)
    axes = axes * np.array([1.0, 1.0, float(np.sign(np.linalg.det(axes)))])  # right-handed
    x, y, z = centre.tolist()
    a, b, c = values.tolist()
    return Pose((x, y, z), quaternion(axes)), (a, b, c)


_BOX_FACES = (
    (0, 1, 3), (0, 3, 2),  # x low
    (4, 6, 7), (4, 7, 5),  # x high
    (0, 4, 5), (0, 5, 1),  # y low
    (2, 3, 7), (2, 7, 6),  # y high
    (0, 2, 6), (0, 6, 4),  # z low
    (1, 5, 7), (1, 7, 3),  # z high
)  # fmt: skip
