"""Orthographic images of meshes, rectangles and points from straight above, in compiled code.

Image coordinates ``(u, v)`` are world x and y in pixels from the image's centre. The centre of pixel
``(i, j)`` lies at ``(i - (size - 1) / 2, j - (size - 1) / 2)``. Corners are snapped to a fixed grid that
contains all pixel centres (50 nm for the default images). Within 512 pixels of the centre the edge
functions are then computed without rounding, which gives three exact properties: adjacent triangles leave no
hole, a face that is vertical up to rounding covers nothing, and a scene rotated by 90 degrees gives the
rotated image, bit for bit. The code uses neither fastmath nor threads, so that the same input always gives
the same image.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from bulletarm_gym.geometry import FloatArray, IntArray, Mesh, Rectangle
from bulletarm_gym.geometry.compilation import compiled

SUBPIXELS = 65536.0
"""Grid steps per pixel: 2**16, so that products of two numbers of 26 bits are exact in 53 bits."""

HEIGHT_STEPS = float(2**30)
"""Grid steps per metre of height (1 nm), which hide the rounding of poses."""

Labels = NDArray[np.int16]
"""Number of the visible mesh of each pixel, from 1 on; 0 where no mesh is visible."""


class Window(NamedTuple):
    """Square of the world that an image shows; rows grow with world x, columns with y.

    :param centre: world x and y of its centre (m)
    :param extent: its side (m)
    :param size: pixels a side
    """

    centre: tuple[float, float]
    extent: float
    size: int


@compiled
def _snap(value: float, steps: float) -> float:
    """Round to a multiple of ``1 / steps``, symmetrically about zero."""
    return np.rint(value * steps) / steps  # type: ignore[no-any-return]


@compiled
def _pixels(low: float, high: float, size: int) -> tuple[int, int]:
    """Return the half-open index range of the pixels whose centre is in [low, high]."""
    middle = 0.5 * (size - 1)
    first = min(max(math.ceil(low + middle), 0.0), float(size))
    end = min(max(math.floor(high + middle) + 1.0, first), float(size))
    return int(first), int(end)


@compiled
def _draw_triangle(
    image: NDArray[np.float32],
    labels: Labels | None,
    label: int,
    corners: FloatArray,
    ia: int,
    ib: int,
    ic: int,
) -> None:
    """Raise and label the pixels whose centre a triangle of corners (u, v, height) covers, if it faces up."""
    au, av, ah = corners[ia, 0], corners[ia, 1], corners[ia, 2]
    bu, bv, bh = corners[ib, 0] - au, corners[ib, 1] - av, corners[ib, 2] - ah
    cu, cv, ch = corners[ic, 0] - au, corners[ic, 1] - av, corners[ic, 2] - ah
    area = bu * cv - cu * bv  # twice the signed area
    if not area > 0.0:
        return
    size = image.shape[0]
    top, bottom = _pixels(au + min(0.0, bu, cu), au + max(0.0, bu, cu), size)
    left, right = _pixels(av + min(0.0, bv, cv), av + max(0.0, bv, cv), size)
    first_u, first_v = top - 0.5 * (size - 1) - au, left - 0.5 * (size - 1) - av
    slope_u, slope_v = (bh * cv - ch * bv) / area, (bu * ch - cu * bh) / area
    for row in range(top, bottom):
        u = first_u + (row - top)
        line = image[row, left:right]
        for column in range(len(line)):  # free of branches, so that it is vectorised
            v = first_v + column
            weight_b, weight_c = u * cv - v * cu, bu * v - bv * u
            inside = (weight_b >= 0.0) & (weight_c >= 0.0) & (weight_b + weight_c <= area)
            # Summed in this order the height does not depend on which of the axes is u.
            height = np.float32(ah + (slope_u * u + slope_v * v))
            if labels is not None:  # the compiler omits this branch if it is None
                marks = labels[row, left:right]
                marks[column] = np.int16(label) if inside & (height > line[column]) else marks[column]
            line[column] = height if inside & (height > line[column]) else line[column]


@compiled
def _draw_meshes(
    labels: Labels | None,
    vertices: FloatArray,
    faces: IntArray,
    ranges: NDArray[np.int64],
    positions: FloatArray,
    rotations: FloatArray,
    visible: NDArray[np.bool_],
    square: tuple[float, float, float],
    size: int,
) -> NDArray[np.float32]:
    """Draw n posed meshes into a new heightmap, see :class:`ZBuffer`."""
    image = np.zeros((size, size), np.float32)
    corners = np.empty_like(vertices)
    for index in range(len(visible)):
        if not visible[index]:
            continue
        centre_x, centre_y, centre_z = positions[index]
        start, first_face, end, end_face = ranges[index]
        matrix, scale = rotations[index], size / square[2]
        for vertex in range(end - start):
            x, y, z = vertices[start + vertex]
            u = (centre_x - square[0]) + (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z)
            v = (centre_y - square[1]) + (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z)
            height = centre_z + (matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z)
            corners[vertex, 0] = _snap(u * scale, SUBPIXELS)
            corners[vertex, 1] = _snap(v * scale, SUBPIXELS)
            corners[vertex, 2] = _snap(height, HEIGHT_STEPS)
        for face in range(first_face, end_face):
            _draw_triangle(image, labels, index + 1, corners, faces[face, 0], faces[face, 1], faces[face, 2])
    return image


@compiled
def _draw_rectangles(
    rectangles: FloatArray, square: tuple[float, float, float], size: int
) -> NDArray[np.float32]:
    """Return an image that is 1 where a rectangle covers the centre of a pixel, else 0."""
    image = np.zeros((size, size), np.float32)
    corners, scale = np.ones((4, 3)), size / square[2]
    for index in range(len(rectangles)):
        x, y, length, width, yaw = rectangles[index]
        along_x, along_y = 0.5 * length * math.cos(yaw), 0.5 * length * math.sin(yaw)
        across_x, across_y = -0.5 * width * math.sin(yaw), 0.5 * width * math.cos(yaw)
        for corner in range(3):
            along, across = (1.0 if corner == 1 else -1.0), (1.0 if corner == 2 else -1.0)
            corner_x = x + along * along_x + across * across_x
            corner_y = y + along * along_y + across * across_y
            corners[corner, 0] = _snap((corner_x - square[0]) * scale, SUBPIXELS)
            corners[corner, 1] = _snap((corner_y - square[1]) * scale, SUBPIXELS)
        corners[3, :2] = corners[1, :2] + corners[2, :2] - corners[0, :2]
        _draw_triangle(image, None, 0, corners, 0, 1, 2)
        _draw_triangle(image, None, 0, corners, 3, 2, 1)
    return image


def rectangle_mask(window: Window, rectangles: Sequence[Rectangle]) -> NDArray[np.bool_]:
    """Return a mask of the pixels whose centre lies in one of the rectangles or on an edge, (size, size).

    A rectangle without area, or with a number that is not finite, covers nothing.
    """
    rows = np.array(rectangles, dtype=np.float64).reshape(len(rectangles), len(Rectangle._fields))
    square = (*window.centre, window.extent)
    mask: NDArray[np.bool_] = _draw_rectangles(rows, square, window.size) > 0.0
    return mask


def project_points(points: FloatArray, window: Window, ceiling: float) -> NDArray[np.float32]:
    """Return the height of the highest point over every pixel (paper, Close-loop Environments).

    A pixel without points gets the value of the nearest pixel with points.

    :param points: (n, 3) world coordinates (m)
    :param ceiling: height (m) above which points are ignored
    :return: (size, size) heights (m), zeros if no point is in the window
    """
    centre, extent, size = window
    cells = np.floor((points[:, :2] - (np.asarray(centre) - extent / 2.0)) * (size / extent)).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(axis=1) & (points[:, 2] <= ceiling)
    if not inside.any():
        return np.zeros((size, size), dtype=np.float32)
    image = np.full((size, size), -np.inf, dtype=np.float32)
    np.maximum.at(image, tuple(cells[inside].T), points[inside, 2].astype(np.float32))
    columns, rows = distance_transform_edt(np.isneginf(image.T), return_distances=False, return_indices=True)
    return np.ascontiguousarray(image[rows, columns].T)


class ZBuffer:
    """Z-buffer that looks straight down on a fixed list of n meshes; faces that look down are never drawn.

    Heights are those under pixel centres, not averages over pixels. A rotation of scene and window by
    ``(x, y) -> (-y, x)`` rotates the image by ``np.rot90(image, k=1)``, bit for bit.
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        ends = np.cumsum([(len(mesh.vertices), len(mesh.faces)) for mesh in meshes] or [(0, 0)], axis=0)
        starts = ends - np.diff(ends, axis=0, prepend=0)
        # First vertex, first face, end of vertices and end of faces of each mesh, (n, 4).
        self._ranges = np.hstack([starts, ends]).astype(np.int64)
        self._vertices = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)])
        self._faces = np.concatenate([np.empty((0, 3), np.int32), *(mesh.faces for mesh in meshes)])

    def draw(
        self,
        positions: FloatArray,
        rotations: FloatArray,
        visible: NDArray[np.bool_],
        window: Window,
        labels: Labels | None = None,
    ) -> NDArray[np.float32]:
        """Return the height of the highest surface under the centre of every pixel, 0 where there is none.

        A mesh whose pose is not finite is not drawn.

        :param positions: (n, 3) float64, world positions of the meshes' frames (m)
        :param rotations: (n, 3, 3) float64, rotation matrices of the meshes' frames
        :param visible: (n,) mask of the meshes to draw
        :param labels: (size, size), in which the number of a mesh, from 1 on, is set where it is visible
        :return: (size, size) height above world z = 0 (m)
        :raises ValueError: the window is empty
        """
        if not (window.extent > 0.0 and window.size > 0):
            raise ValueError(f"extent and size must be positive, got {window.extent} and {window.size}")
        meshes, square = (self._vertices, self._faces, self._ranges), (*window.centre, window.extent)
        return _draw_meshes(labels, *meshes, positions, rotations, visible, square, window.size)
