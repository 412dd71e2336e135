"""Interface of a sensor."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations.view import View
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import Camera


class Sensor(ABC):
    """One entry of the observation.

    A sensor changes nothing. Its reading follows from the scene and :attr:`memory`, so that states can be
    saved and restored. A subclass may have parameters, which the list of sensors sets by name to JSON values.

    :param scene: scene with all bodies loaded, before the first arrangement
    """

    controls: ClassVar[tuple[str, ...]] = (CLOSE_LOOP, OPEN_LOOP)
    """Names of the controls that the sensor works with."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.memory: Any = None
        """Memory within an episode, part of the state: plain values or bytes; None at the start."""

    @property
    @abstractmethod
    def space(self) -> spaces.Box:
        """Shape, type and bounds of the arrays that :meth:`read` returns."""

    @abstractmethod
    def read(self, view: View) -> NDArray[Any]:
        """Return the reading, a new array.

        :param view: view of the scene from above, rendered once for all sensors
        """

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras of the sensor at present, by the suffix of their names; by default none."""
        return {}

    def follow(self, before: View, pick: Pose | None) -> None:  # noqa: B027 (most have no memory)
        """Update :attr:`memory` after an action that was not ignored.

        :param before: view before the action; its labels can no longer be read
        :param pick: target pose of the fingertips, if the action was an open-loop pick
        """

    @property
    def follows(self) -> bool:
        """Return True if the sensor defines :meth:`follow`."""
        return type(self).follow is not Sensor.follow
