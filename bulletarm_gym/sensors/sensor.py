"""The contract of a sensor."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.geometry import Pose
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors.view import View
from bulletarm_gym.simulation import Camera


class Sensor(ABC):
    """What an agent sees under one name.

    A sensor looks and changes nothing. What it returns follows from the scene and from :attr:`memory`, so
    that states can be saved and restored.

    A subclass may take parameters of its own, by name: JSON values, as the user writes them into the list of
    sensors.

    :param scene: what it looks at, its bodies loaded, nothing arranged yet
    """

    controls: ClassVar[tuple[str, ...]] = (CLOSE_LOOP, OPEN_LOOP)
    """Names of the controls it can be had with."""
    asks_for_labels: ClassVar[bool] = False
    """Whether it reads which part of the scene a pixel shows, which is then drawn along with the heights."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.memory: Any = None
        """What it must remember within an episode: plain values, bytes among them; None when one begins."""

    @property
    @abstractmethod
    def space(self) -> spaces.Box:
        """What :meth:`read` returns: its shape, type and limits."""

    @abstractmethod
    def read(self, view: View) -> NDArray[Any]:
        """Return what there is to be seen, a new array.

        :param view: the heights of the scene from above, drawn once for all sensors
        """

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras of the sensor, by the suffix that the name of the sensor gets; by default none."""
        return {}

    def follow(self, before: View, pick: Pose | None) -> None:  # noqa: B027 (most have no memory)
        """Note that an action was carried out.

        :param before: what was seen before it
        :param pick: where the fingertips closed, if it was an open-loop pick
        """

    @property
    def follows(self) -> bool:
        """Whether the sensor defines :meth:`follow`."""
        return type(self).follow is not Sensor.follow
