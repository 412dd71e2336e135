"""What every control does: read actions, act on a scene, say what is seen of it."""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Generic, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import EnvConfig, ParameterError
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.robots.robot import LEVEL_TILT
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors import Frame, View

POINTS = 5
"""Number of positions along each side of the workspace at which the arm's reach is checked."""
MIN_REACH = 0.7
"""Minimum share of these positions that must be in reach with an upright gripper."""
MIN_TILTED_REACH = 0.5
"""Minimum share that must be in reach with a tilted gripper, if actions tilt it."""

Move = TypeVar("Move")


@dataclass(frozen=True)
class Outcome:
    """What became of a move.

    :param ignored: it changed nothing
    :param pick: where the fingertips closed, if it was a pick
    """

    ignored: bool
    pick: Pose | None = None


class Control(ABC, Generic[Move]):
    """How the arm is commanded, by actions of one number in [-1, 1] a character of ``action_sequence``.

    A class that can be used is made from ``(config, scene, task)``.

    :param config: the environment's parameters
    :param scene: what is acted on
    :param home: of the fingertips when an episode begins
    :param poses: fingertip poses all over the workspace, of which a minimum share must be in reach
    :raises ParameterError: ``home`` or too many of ``poses`` are out of reach
    """

    kind: ClassVar[str]
    """``"close_loop"`` or ``"open_loop"``: whose tasks and parameters it takes."""
    sequences: ClassVar[tuple[str, ...]] = ()
    """What an action can consist of, a character a number, in any order, the default first; that of its kind,
    if empty."""

    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """What -1 and 1 of an action's numbers stand for (m, rad), by name."""

    def __init__(self, config: EnvConfig, scene: Scene, home: Pose, poses: Iterable[Pose]) -> None:
        if not scene.robot.reaches(home):
            takes = f"one whose middle robot={config.robot!r} reaches at a height of {home.z:g} m"
            raise ParameterError.of("workspace", config.workspace, takes)
        upright: list[Pose] = []
        tilted: list[Pose] = []
        for pose in poses:
            (tilted if pose.tilt > LEVEL_TILT else upright).append(pose)
        _check_reach(config, scene, upright, MIN_REACH, "an upright")
        _check_reach(config, scene, tilted, MIN_TILTED_REACH, "a tilted")
        self.sequence = config.action_sequence
        self._home = home
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.sequence),), np.float32)

    def numbers(self, action: ArrayLike) -> list[float]:
        """Return an action's numbers, clipped to [-1, 1].

        :raises ValueError: the action has the wrong shape or is not finite
        """
        try:
            array = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != self.action_space.shape or not np.isfinite(array).all():
            raise ValueError(
                f"action: got {action!r}, takes {len(self.sequence)} finite numbers, "
                f"one each for {self.sequence!r}"
            )
        numbers: list[float] = array.clip(-1.0, 1.0).tolist()
        return numbers

    @abstractmethod
    def decode_action(self, action: ArrayLike, view: View) -> Move:
        """Return what an action means; numbers outside [-1, 1] are clipped.

        :param view: what was seen last: where the action does not say at which height, it follows from there
        :raises ValueError: the action has the wrong shape or is not finite
        """

    @abstractmethod
    def encode_action(self, move: Move) -> NDArray[np.float32]:
        """Return the action for a move, the inverse of :meth:`decode_action`; what is too far is clipped."""

    def start(self, scene: Scene) -> None:
        """Put the empty, open gripper where an episode begins."""
        scene.robot.home(self._home)

    @abstractmethod
    def apply(self, scene: Scene, move: Move) -> Outcome:
        """Carry out a move."""

    @abstractmethod
    def frame(self, scene: Scene) -> Frame:
        """Return the part of the scene that is seen from above at present."""

    @abstractmethod
    def next_move(self, scene: Scene, plan: Iterator[Waypoint]) -> Move:
        """Return the move that follows a plan."""


def _check_reach(config: EnvConfig, scene: Scene, poses: list[Pose], least: float, gripper: str) -> None:
    """Check that a minimum share of poses is in reach.

    :raises ParameterError: it is not
    """
    far = [pose for pose in poses if not scene.robot.reaches(pose)]
    if len(far) > (1.0 - least) * len(poses):
        x, y, z = far[0].position
        takes = (
            f"one of which robot={config.robot!r} reaches at least {least:.0%} with {gripper} gripper; "
            f"it reaches {1.0 - len(far) / len(poses):.0%}, for example not ({x:g}, {y:g}, {z:g})"
        )
        raise ParameterError.of("workspace", config.workspace, takes)


def over(config: EnvConfig, heights: Iterable[float], points: int) -> Iterator[Vector]:
    """Yield positions (m) all over the workspace, ``points`` a side, the border included, at some heights."""
    xs, ys = (np.linspace(low, high, points).tolist() for low, high in config.workspace[:2])
    return itertools.product(xs, ys, heights)
