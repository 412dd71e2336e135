"""Centre of mass and inertia of solids made of closed meshes of one density."""

from collections.abc import Sequence

import numpy as np

from bulletarm_gym.geometry import FloatArray, Mesh, Pose, Vector, quaternion

_CANONICAL = (np.ones((3, 3)) + np.eye(3)) / 120.0
"""Second moments of the tetrahedron between the origin and the three unit vectors."""


def mass_properties(meshes: Sequence[Mesh], mass: float) -> tuple[Pose, Vector]:
    """Return the frame of the principal axes at the centre of mass, and the inertia (kg m^2) about them.

    :param meshes: closed, with outward faces; where they overlap, matter counts twice
    :param mass: of all of them together (kg)
    :raises ValueError: the meshes enclose nothing
    """
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    jacobians = np.transpose(corners, (0, 2, 1))
    six_volumes = np.linalg.det(jacobians)
    volume = six_volumes.sum() / 6.0
    if volume <= 0.0:
        raise ValueError("the meshes enclose no volume; their faces must be closed and look outward")
    centre = (six_volumes[:, None] * corners.sum(axis=1)).sum(axis=0) / (24.0 * volume)
    moments = np.einsum("n,nij,jk,nlk->il", six_volumes, jacobians, _CANONICAL, jacobians)
    covariance = (moments / volume - np.outer(centre, centre)) * mass
    values, axes = np.linalg.eigh(np.trace(covariance) * np.eye(3) - covariance)
    x, y, z = centre.tolist()
    a, b, c = values.tolist()
    return Pose((x, y, z), quaternion(_right_handed(axes))), (a, b, c)


def _right_handed(axes: FloatArray) -> FloatArray:
    turned: FloatArray = axes * np.array([1.0, 1.0, float(np.sign(np.linalg.det(axes)))])
    return turned
