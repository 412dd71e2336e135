"""Orthographic heightmaps of the scene's meshes, and which mesh each pixel shows."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, Mesh
from bulletarm_gym.rendering.rasterizer import Labels, draw_parts


class ZBuffer:
    """A z-buffer that looks straight down on a fixed list of meshes, one a body link.

    Heights are those under pixel centres, not averages over pixels. With ``resolution = extent / size``,
    pixel ``(i, j)`` covers world x from ``centre[0] - extent / 2 + i * resolution`` to one resolution more,
    y with ``j`` likewise, and its centre lies half a pixel in. Thanks to the half pixel the image has no
    preferred corner: turning scene and window by +90 degrees about z, ``(x, y) -> (-y, x)``, turns the image
    by ``np.rot90(image, k=1)``, bit for bit.

    :param meshes: closed or open meshes whose outside is seen; faces that look down are never drawn
    :raises ValueError: if a face names a vertex its mesh does not have, or a vertex is not finite
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        for index, mesh in enumerate(meshes):
            _check(mesh, index)
        ends = np.cumsum([(len(mesh.vertices), len(mesh.faces)) for mesh in meshes] or [(0, 0)], axis=0)
        starts = ends - np.diff(ends, axis=0, prepend=0)
        self._ranges = np.ascontiguousarray(
            np.stack([starts[:, 0], ends[:, 0], starts[:, 1], ends[:, 1]], axis=1)[: len(meshes)],
            dtype=np.int64,
        )
        self._vertices = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)])
        self._faces = np.concatenate([np.empty((0, 3), np.int32), *(mesh.faces for mesh in meshes)])
        self._spheres = np.array([_bounding_sphere(mesh) for mesh in meshes]).reshape(-1, 4)

    def heights(
        self,
        positions: FloatArray,
        quaternions: FloatArray,
        visible: NDArray[np.bool_],
        centre: tuple[float, float],
        extent: float,
        size: int,
        floor: float = 0.0,
    ) -> NDArray[np.float32]:
        """Return the height of the highest surface under the centre of every pixel.

        A mesh whose pose is not finite is not drawn.

        :param positions: (n, 3) world positions of the meshes' frames (m)
        :param quaternions: (n, 4) world orientations of the meshes' frames, ``(x, y, z, w)``
        :param visible: (n,) bool, which meshes are drawn
        :param centre: world x and y of the middle of the image (m)
        :param extent: side of the square seen (m)
        :param size: pixels a side
        :param floor: height where there is no mesh (m); nothing lower is seen
        :return: (size, size) float32, height above world z = 0 (m); rows grow with world x, columns with y
        :raises ValueError: if there is not one pose and one flag a mesh, or the window is empty
        """
        return self._draw(None, positions, quaternions, visible, (*centre, extent), size, floor)

    def labelled(
        self,
        positions: FloatArray,
        quaternions: FloatArray,
        visible: NDArray[np.bool_],
        marks: NDArray[np.bool_],
        centre: tuple[float, float],
        extent: float,
        size: int,
        floor: float = 0.0,
    ) -> tuple[NDArray[np.float32], Labels]:
        """Return the heights, the same as :meth:`heights`, and which mesh is seen under every pixel's centre.

        :param marks: (n,) bool, which meshes are marks on the floor: seen where nothing lies on them, without
            a height of their own
        :return: (size, size) float32, m; (size, size) int16, 0 where no mesh is seen, else 1 and its place in
            the list
        :raises ValueError: as :meth:`heights`
        """
        window = (*centre, extent)
        labels = np.zeros((size, size), np.int16)
        if (visible & marks).any():
            self._draw(labels, positions, quaternions, visible & marks, window, size, floor)
        return self._draw(labels, positions, quaternions, visible & ~marks, window, size, floor), labels

    def _draw(
        self,
        labels: Labels | None,
        positions: FloatArray,
        quaternions: FloatArray,
        visible: NDArray[np.bool_],
        window: tuple[float, float, float],
        size: int,
        floor: float,
    ) -> NDArray[np.float32]:
        count = len(self._ranges)
        if not (
            positions.shape == (count, 3) and quaternions.shape == (count, 4) and visible.shape == (count,)
        ):
            raise ValueError(
                f"For {count} meshes positions, quaternions and visible have shapes ({count}, 3), "
                f"({count}, 4) and ({count},), not {positions.shape}, {quaternions.shape} and {visible.shape}"
            )
        x, y, extent = window
        if not (extent > 0.0 and size > 0):
            raise ValueError(f"extent and size must be positive, not {extent} and {size}")
        return draw_parts(
            labels,
            self._vertices,
            self._faces,
            self._ranges,
            self._spheres,
            # Of one type and layout: numba would compile another version, for seconds, for every other.
            np.ascontiguousarray(positions, dtype=np.float64),
            np.ascontiguousarray(quaternions, dtype=np.float64),
            np.ascontiguousarray(visible, dtype=np.bool_),
            (float(x), float(y), float(extent)),
            size,
            float(floor),
        )


def _check(mesh: Mesh, index: int) -> None:
    """Refuse a mesh that the compiled code, which checks no bounds, could not draw."""
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"Mesh {index} has a vertex that is not finite")
    if mesh.faces.size and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise ValueError(f"Mesh {index} has a face that names none of its {len(mesh.vertices)} vertices")


def _bounding_sphere(mesh: Mesh) -> FloatArray:
    """Return centre and radius of a sphere around a mesh, (4,) metres."""
    if not len(mesh.vertices):
        return np.zeros(4)
    centre = mesh.bounds.mean(axis=0)
    return np.append(centre, np.linalg.norm(mesh.vertices - centre, axis=1).max())
