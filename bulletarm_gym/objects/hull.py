"""The convex hull of points in space."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from bulletarm_gym.geometry import FloatArray, Mesh

FLAT = 1e-6
"""Ratio of thickness to length below which points lie in a plane."""


def convex_hull(points: ArrayLike) -> Mesh:
    """Return the convex hull of points (m) as a closed mesh whose faces look outward.

    :param points: (n, 3) of any shape with volume
    :raises ValueError: a point is not finite, or all lie in a plane
    """
    cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(cloud).all():
        raise ValueError("a vertex is not finite")
    cloud = np.unique(cloud, axis=0)
    if len(cloud) < 4:
        raise ValueError(f"{len(cloud)} different vertices enclose no volume")
    middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2.0
    unit = (cloud - middle) / np.ptp(cloud, axis=0).max()  # Qhull's tolerances grow with the coordinates
    if _thickness(unit) < FLAT:
        raise ValueError("the vertices lie in a plane and enclose no volume")
    hull = ConvexHull(unit)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    return Mesh.of(cloud[used], _outward(unit[used], faces.reshape(-1, 3)))


def _thickness(cloud: FloatArray) -> float:
    """Return the extent of points along their shortest principal axis."""
    _, _, axes = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)
    return float(np.ptp(cloud @ axes[2]))


def _outward(vertices: FloatArray, faces: "np.ndarray[tuple[int, ...], np.dtype[np.intp]]") -> FloatArray:
    """Return the faces counter-clockwise seen from outside, without those of no area."""
    corners = vertices[faces] - vertices.mean(axis=0)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turned = np.where((np.einsum("fi,fi->f", normals, corners[:, 0]) < 0.0)[:, None], faces[:, ::-1], faces)
    found: FloatArray = turned[np.linalg.norm(normals, axis=1) > 0.0]
    return found
