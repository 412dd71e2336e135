"""Compiled scan conversion of triangles and rectangles as seen from straight above.

Image coordinates ``(u, v)`` are world x and y in pixels from the middle of the image; the centre of pixel
``(i, j)`` lies at ``(i - (size - 1) / 2, j - (size - 1) / 2)``. Corners are snapped to a fixed grid that
holds all pixel centres and is too fine to matter (50 nm for the default images). Within 512 pixels of the
middle the edge functions are then computed without any rounding, which gives three exact properties:
neighbouring triangles leave no hole, a face that is vertical up to rounding covers nothing, and a scene
turned by 90 degrees is drawn as the turned image, bit for bit.

No fastmath and no threads: the same input always gives the same image.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.geometry import FloatArray, IntArray
from bulletarm_gym.geometry.compilation import compiled

SUBPIXELS = 65536.0
"""Grid steps a pixel: 16 bits, so that a product of two numbers of 10 bits more fits the 53 of a double."""

HEIGHT_STEPS = float(2**30)
"""Grid steps a metre of height (1 nm): the rounding of poses does not reach the image."""

Labels = NDArray[np.int16]
"""Which part each pixel shows: 0 none, else its number from 1 on."""

Window = tuple[float, float, float]
"""Centre x, centre y and side of the square that an image shows (m)."""


@compiled
def _snap(value: float, steps: float) -> float:
    """Round to a multiple of ``1 / steps``; symmetric about zero."""
    return np.rint(value * steps) / steps  # type: ignore[no-any-return]


@compiled
def _rotation(quaternion: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation matrix of an ``(x, y, z, w)`` quaternion, which need not be normalised."""
    x, y, z, w = quaternion
    s = 2.0 / (x * x + y * y + z * z + w * w)
    matrix = np.empty((3, 3))
    matrix[0] = 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    matrix[1] = s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)
    matrix[2] = s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)
    return matrix


@compiled
def _pixels(low: float, high: float, size: int) -> tuple[int, int]:
    """Return the first index, and the one after the last, of pixels with a centre in [low, high]."""
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
    """Raise the pixels whose centre a triangle of corners (u, v, height) covers, if it faces up.

    With ``labels`` what is raised is labelled; without, the compiler leaves that branch out.
    """
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
            if labels is not None:
                marks = labels[row, left:right]
                marks[column] = np.int16(label) if inside & (height > line[column]) else marks[column]
            line[column] = height if inside & (height > line[column]) else line[column]


@compiled
def _fits(matrix: FloatArray, origin: tuple[float, float, float], sphere: FloatArray, half: float) -> bool:
    """Tell whether a bounding sphere may reach into the window; false for a pose that is not finite."""
    x = origin[0] + matrix[0, 0] * sphere[0] + matrix[0, 1] * sphere[1] + matrix[0, 2] * sphere[2]
    y = origin[1] + matrix[1, 0] * sphere[0] + matrix[1, 1] * sphere[1] + matrix[1, 2] * sphere[2]
    return bool(abs(x) <= half + sphere[3] and abs(y) <= half + sphere[3])


@compiled
def _project(
    vertices: FloatArray,
    matrix: FloatArray,
    origin: tuple[float, float, float],
    scale: float,
    corners: FloatArray,
) -> None:
    """Write the image coordinates and heights of a part's vertices into ``corners``."""
    for index in range(len(vertices)):
        x, y, z = vertices[index, 0], vertices[index, 1], vertices[index, 2]
        u = origin[0] + (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z)
        v = origin[1] + (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z)
        height = origin[2] + (matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z)
        corners[index, 0] = _snap(u * scale, SUBPIXELS)
        corners[index, 1] = _snap(v * scale, SUBPIXELS)
        corners[index, 2] = _snap(height, HEIGHT_STEPS)


@compiled
def draw_parts(
    labels: Labels | None,
    vertices: FloatArray,
    faces: IntArray,
    ranges: NDArray[np.int64],
    spheres: FloatArray,
    positions: FloatArray,
    quaternions: FloatArray,
    visible: NDArray[np.bool_],
    window: Window,
    size: int,
    floor: float,
) -> NDArray[np.float32]:
    """Draw posed meshes into a new heightmap.

    :param labels: (size, size), or None; where a part is seen it becomes the part's number, from 1 on
    :param vertices: (V, 3) vertices of all parts in their own frames (m)
    :param faces: (F, 3) vertex indices, counted from the first vertex of the part
    :param ranges: (n, 4) of a part: first vertex, end of vertices, first face, end of faces
    :param spheres: (n, 4) centre in the frame of the part and radius of a sphere around it (m)
    :param positions: (n, 3) world positions (m)
    :param quaternions: (n, 4) world orientations, ``(x, y, z, w)``
    :param visible: (n,) which parts to draw
    :param window: centre x, centre y and side of the square seen (m)
    :param size: pixels a side
    :param floor: height where nothing is seen (m)
    :return: (size, size) heights (m)
    """
    image = np.full((size, size), floor, np.float32)
    corners = np.empty_like(vertices)
    for part in range(len(ranges)):
        if not visible[part]:
            continue
        x, y, z = positions[part]
        origin = (x - window[0], y - window[1], z)
        matrix = _rotation(quaternions[part])
        if not _fits(matrix, origin, spheres[part], 0.5 * window[2]):
            continue
        start, end, first_face, end_face = ranges[part]
        _project(vertices[start:end], matrix, origin, size / window[2], corners)
        for face in range(first_face, end_face):
            _draw_triangle(image, labels, part + 1, corners, faces[face, 0], faces[face, 1], faces[face, 2])
    return image


@compiled
def _image_point(x: float, y: float, window: Window, size: int) -> tuple[float, float]:
    """Return the snapped image coordinates of a point of the world."""
    scale = size / window[2]
    return _snap((x - window[0]) * scale, SUBPIXELS), _snap((y - window[1]) * scale, SUBPIXELS)


@compiled
def draw_rectangles(image: NDArray[Any], rectangles: FloatArray, window: Window, value: float | bool) -> None:
    """Set the pixels whose centre a rectangle covers, its edges included.

    :param image: (size, size), changed in place
    :param rectangles: (k, 5) world x and y of the centre, length along the rectangle's own x axis and width
        (m), yaw (rad); one without area or with a number that is not finite covers nothing
    :param window: centre x, centre y and side of the square seen (m)
    :param value: what to set, of the type of the image
    """
    size = image.shape[0]
    for index in range(len(rectangles)):
        x, y, length, width, yaw = rectangles[index]
        along_x, along_y = 0.5 * length * math.cos(yaw), 0.5 * length * math.sin(yaw)
        across_x, across_y = -0.5 * width * math.sin(yaw), 0.5 * width * math.cos(yaw)
        au, av = _image_point(x - along_x - across_x, y - along_y - across_y, window, size)
        bu, bv = _image_point(x + along_x - across_x, y + along_y - across_y, window, size)
        cu, cv = _image_point(x - along_x + across_x, y - along_y + across_y, window, size)
        bu, bv, cu, cv = bu - au, bv - av, cu - au, cv - av
        area = bu * cv - cu * bv
        if not area > 0.0:
            continue
        top, bottom = _pixels(au + min(0.0, bu, cu, bu + cu), au + max(0.0, bu, cu, bu + cu), size)
        left, right = _pixels(av + min(0.0, bv, cv, bv + cv), av + max(0.0, bv, cv, bv + cv), size)
        for row in range(top, bottom):
            for column in range(left, right):
                u, v = row - 0.5 * (size - 1) - au, column - 0.5 * (size - 1) - av
                if 0.0 <= u * cv - v * cu <= area and 0.0 <= bu * v - bv * u <= area:
                    image[row, column] = value
