"""Arrangement of the scene at the start of an episode."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bulletarm_gym.control import Control
from bulletarm_gym.geometry import PlacementError
from bulletarm_gym.scene import Scene

ARRANGEMENTS = 30
"""Maximum number of arrangements that a reset tries."""


def arrange_scene(
    scene: Scene,
    control: Control[Any],
    arrange: Callable[[Scene, np.random.Generator], None],
    rng: np.random.Generator,
    changed: Sequence[str],
) -> None:
    """Sample surfaces and arrangements until the objects fit.

    :param arrange: arrangement of the task in an empty scene
    :param changed: names of the parameters of the scene that differ from their defaults
    :raises PlacementError: the objects do not fit; the text names these parameters
    """
    for attempt in range(1, ARRANGEMENTS + 1):
        scene.clear(rng)
        control.start()
        try:
            return arrange(scene, rng)
        except PlacementError as error:
            if attempt == ARRANGEMENTS:
                values = ", ".join(repr(getattr(scene.config, name)) for name in changed)
                must = f"{', '.join(changed)} must leave room for all objects, got {values}: "
                raise PlacementError(f"{must if changed else ''}{error}") from error
