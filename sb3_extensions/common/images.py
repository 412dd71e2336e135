"""Classification of the entries of an observation by their shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

IMAGE_AXES = 3
"""Number of axes of an image: channels, rows, columns."""


def is_point_cloud(shape: Sequence[int]) -> bool:
    """Return True for the shape (n, 3) of a point cloud."""
    return len(shape) == 2 and shape[-1] == 3


def scene_images(shapes: Mapping[str, Sequence[int]]) -> list[str]:
    """
    Return the keys of the images of the scene, the images of the largest size.

    Smaller images, such as the in-hand image, do not rotate or shift with the scene.

    :param shapes: shape of each entry of an observation, images (channels, rows, columns)
    :return: keys in the order of the shapes
    """
    sides = {key: max(shape[1:]) for key, shape in shapes.items() if len(shape) == IMAGE_AXES}
    return [key for key, side in sides.items() if side == max(sides.values())]
