"""The convex hull of points in space."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.geometry import FloatArray, Mesh

Indices = NDArray[np.int64]

TOLERANCE = 1e-7
"""Share of the points' spread that counts as no distance."""


def convex_hull(points: ArrayLike) -> Mesh:
    """Return the convex hull of points (m): each point outside the hull so far is joined to the rim it sees.

    :param points: (n, 3) of any shape with volume
    :raises ValueError: a point is not finite, or all lie in a plane
    """
    cloud = np.asarray(points, dtype=np.float64)
    if not np.isfinite(cloud).all():
        raise ValueError("a vertex is not finite")
    cloud = np.unique(cloud.reshape(-1, 3), axis=0)
    spread = float(np.ptp(cloud, axis=0).max()) if len(cloud) else 0.0
    faces = _first_tetrahedron(cloud, TOLERANCE * spread)
    for index in range(len(cloud)):
        normals, offsets = _planes(cloud, faces)
        seen = normals @ cloud[index] - offsets > TOLERANCE * spread
        if seen.any():
            faces = np.concatenate([faces[~seen], _cone(faces[seen], index)])
    used, renamed = np.unique(faces, return_inverse=True)
    return Mesh.of(cloud[used], renamed)


def _first_tetrahedron(cloud: FloatArray, tolerance: float) -> Indices:
    """Return the outward faces of a tetrahedron of four points far from each other."""
    if len(cloud) < 4:
        raise ValueError(f"{len(cloud)} different vertices enclose no volume")
    a = 0
    b = int(np.linalg.norm(cloud - cloud[a], axis=1).argmax())
    c = int(np.linalg.norm(np.cross(cloud - cloud[a], cloud[b] - cloud[a]), axis=1).argmax())
    normal = np.cross(cloud[b] - cloud[a], cloud[c] - cloud[a])
    heights = (cloud - cloud[a]) @ normal / max(float(np.linalg.norm(normal)), 1e-300)
    d = int(np.abs(heights).argmax())
    if abs(heights[d]) <= tolerance:
        raise ValueError("the vertices lie in a plane and enclose no volume")
    if heights[d] > 0.0:
        b, c = c, b
    return np.array([(a, b, c), (a, c, d), (c, b, d), (b, a, d)])


def _planes(cloud: FloatArray, faces: Indices) -> tuple[FloatArray, FloatArray]:
    corners = cloud[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return normals, np.einsum("fi,fi->f", normals, corners[:, 0])


def _cone(seen: Indices, apex: int) -> Indices:
    """Return the faces between a point and the rim of the faces it sees."""
    edges = {(int(a), int(b)) for face in seen for a, b in zip(face, np.roll(face, -1), strict=True)}
    return np.array([(a, b, apex) for a, b in sorted(edges) if (b, a) not in edges])
