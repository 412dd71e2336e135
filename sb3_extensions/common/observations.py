"""Entries of observations by key, with and without a Dict space."""

from collections.abc import Mapping, Sequence
from typing import Any

from gymnasium import spaces

KEY = "observation"
"""Name of the only entry of observations without a Dict space."""
IMAGE_AXES = 3
"""Number of axes of an image: channels, rows, columns."""


def space_parts(space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    """Return the space of each entry of observations."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {KEY: space}


def as_parts(observations: Any) -> dict[str, Any]:
    """Return the entries of observations, a new dictionary."""
    return dict(observations) if isinstance(observations, Mapping) else {KEY: observations}


def scene_images(shapes: Mapping[str, Sequence[int]]) -> list[str]:
    """
    Return the keys of the images of the scene, the images of the largest size, given all shapes.

    Smaller images, such as the in-hand image, do not rotate or shift with the scene.
    """
    sides = {key: max(shape[1:]) for key, shape in shapes.items() if len(shape) == IMAGE_AXES}
    return [key for key, side in sides.items() if side == max(sides.values())]
