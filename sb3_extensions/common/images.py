"""Which parts of an observation show the scene, by their shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

IMAGE_AXES = 3  # channels, rows, columns

POINT_AXES = (2, 3)  # an array of points, each with x, y and z


def is_point_cloud(shape: Sequence[int]) -> bool:
    """Whether a part of an observation of this shape is points (n, 3)."""
    axes, coordinates = POINT_AXES
    return len(shape) == axes and shape[-1] == coordinates


def scene_images(shapes: Mapping[str, Sequence[int]]) -> list[str]:
    """
    Names of the views of the scene: the images of the largest size.

    Smaller ones, such as what was where the gripper closed, do not turn or shift with the scene.

    :param shapes: shape of each part of an observation, images (channels, rows, columns)
    :return: names in the order of the shapes; none if no part is an image
    """
    sides = {key: max(shape[1:]) for key, shape in shapes.items() if len(shape) == IMAGE_AXES}
    return [key for key, side in sides.items() if side == max(sides.values())]
