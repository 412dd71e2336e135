"""Base class of controls: decoding and encoding of actions, motion of the robot, observed frame."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import EnvConfig, ParameterError, default_home_height
from bulletarm_gym.config_checks import check_argument, check_fields, floats, numbers, optional, rule
from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.observations import Frame, View
from bulletarm_gym.robots import Robot
from bulletarm_gym.robots.robot import LEVEL_TILT


class RobotInterface:
    """Commands and measurements of a robot, without the poses of objects.

    Poses are of the fingertips in the world (m). The commands are methods of
    :class:`~bulletarm_gym.robots.robot.Robot`.

    :param robot: the simulated robot
    :param settle: function that simulates until loose objects are at rest
    """

    def __init__(self, robot: Robot, settle: Callable[[], None]) -> None:
        self._robot = robot
        self.stroke = robot.model.gripper.stroke
        """Largest distance (m) between the fingers."""
        self.reset = robot.home
        """Set the empty, open gripper to a pose without moving through the space between."""
        self.move_to, self.transfer, self.move_joints = robot.move_to, robot.transfer, robot.move_joints
        self.set_opening, self.is_apart = robot.set_opening, robot.is_apart
        self.reaches, self.can_move_to = robot.reaches, robot.can_move_to
        self.wait_until_still = settle

    @property
    def pose(self) -> Pose:
        """Measured pose of the fingertips."""
        return self._robot.pose

    @property
    def opening(self) -> float:
        """Measured distance (m) between the fingers."""
        return self._robot.opening

    @property
    def is_holding(self) -> bool:
        """Whether the gripper holds an object."""
        return self._robot.held is not None

    @property
    def joint_positions(self) -> tuple[float, ...]:
        """Measured positions (rad) of the arm joints."""
        return self._robot.joint_positions


POINTS = 5
"""Number of positions along each side of the workspace at which the arm's reach is checked."""
MIN_REACH = 0.7
"""Minimum share of these positions that must be in reach with an upright gripper."""
MIN_TILTED_REACH = 0.5
"""Minimum share that must be in reach with a tilted gripper, if actions tilt it."""

Move = TypeVar("Move")


@dataclass(frozen=True)
class GraspParams:
    """Grasp parameters of a task (paper, Open-loop Environments).

    :param pick_offset: depth (m) of the fingertips below the highest point around the target of a pick, if
        actions have no z
    :param place_offset: gap (m) between the grasped object and the highest point under it at the release, if
        actions have no z
    :param pick_area: length along the opening and width (m) of the area whose highest point counts for a
        pick; by default a square of twice ``pick_offset``
    :param opening: largest distance (m) between the open fingers, for tasks with narrow gaps
    """

    pick_offset: float
    place_offset: float = 0.003
    pick_area: tuple[float, float] | None = None
    opening: float = math.inf

    def __post_init__(self) -> None:
        offsets = dict.fromkeys(("pick_offset", "place_offset"), numbers())
        opening = rule("a non-negative number", lambda width: 0.0 <= width <= math.inf)
        area = optional(numbers("positive", 2))
        check_fields(self, {**offsets, "pick_area": area, "opening": opening})


@dataclass(frozen=True)
class Outcome:
    """Result of a move.

    :param ignored: the move changed nothing
    :param pick: target pose of the fingertips, if the move was a pick
    :param closed_at: measured pose of the fingertips when they closed, if the move was a pick
    """

    ignored: bool
    pick: Pose | None = None
    closed_at: Pose | None = None


class Control(ABC, Generic[Move]):
    """Maps actions to motions of the robot; an action has one number in [-1, 1] per character of
    ``action_sequence``.

    It uses only quantities that are available on a real robot: the action, the last observation, the
    measurements of joints and gripper. The environment constructs a subclass with the arguments
    ``(config, robot, grasp_params)``.

    :param config: the environment's parameters
    :param robot: the robot that executes the moves
    :param poses: fingertip poses all over the workspace, of which a minimum share must be in reach
    :raises ParameterError: the home pose or too many of ``poses`` are out of reach
    """

    kind: ClassVar[str]
    """Kind of control, ``"close_loop"`` or ``"open_loop"``, whose tasks and parameters apply."""
    sequences: ClassVar[tuple[str, ...]] = ()
    """Values of ``action_sequence`` in any order of their characters, the default first; empty for the values
    of the kind."""

    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """Physical values (m, rad) of the numbers -1 and 1, by the name of the number."""

    def __init__(self, config: EnvConfig, robot: RobotInterface, poses: Iterable[Pose]) -> None:
        self.robot = robot
        self.sequence = config.action_sequence
        self.memory: Any = None
        """Memory within an episode, part of the environment's state: plain values; None at the start."""
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.sequence),), np.float32)
        must = f"{len(self.sequence)} finite numbers, one each for {self.sequence!r}"
        self._check = rule(must, bool, floats(len(self.sequence)))
        self._home = Pose.planar(*config.centre, config.home_height)
        _check_reach(config, robot, self._home, list(poses))

    def numbers(self, action: ArrayLike) -> list[float]:
        """Return an action's numbers, clipped to [-1, 1].

        :raises ValueError: the action has the wrong shape or is not finite
        """
        return [min(max(value, -1.0), 1.0) for value in check_argument("action", action, self._check)]

    @abstractmethod
    def decode_action(self, action: ArrayLike, view: View) -> Move:
        """Return the move of an action in physical units; numbers outside [-1, 1] are clipped.

        :param view: last view of the scene, for heights that the action does not specify
        :raises ValueError: the action has the wrong shape or is not finite
        """

    @abstractmethod
    def encode_action(self, move: Move) -> NDArray[np.float32]:
        """Return the action of a move, clipped to [-1, 1]; the inverse of :meth:`decode_action`."""

    def start(self) -> None:
        """Set the empty, open gripper to the pose at the start of an episode."""
        self.robot.reset(self._home)

    @abstractmethod
    def apply(self, move: Move) -> Outcome:
        """Execute a move."""

    def follow(self, before: View, after: View, outcome: Outcome) -> None:
        """Update :attr:`memory` after a move that was not ignored.

        :param before: view before the move
        :param after: view after the move
        :param outcome: result of the move
        """

    @property
    def follows(self) -> bool:
        """Whether the control defines :meth:`follow`."""
        return type(self).follow is not Control.follow

    @abstractmethod
    def frame(self) -> Frame:
        """Return the part of the scene that the heightmap shows."""


def _check_reach(config: EnvConfig, robot: RobotInterface, home: Pose, poses: list[Pose]) -> None:
    if not robot.reaches(home):
        is_default = home.z == default_home_height(config.control, config.workspace)
        name = "workspace" if is_default else "home_height"
        x, y, z = home.position
        takes = f"such that robot={config.robot!r} reaches the home pose ({x:g}, {y:g}, {z:g})"
        raise ParameterError.of(name, getattr(config, name), takes)
    for is_tilted, least in ((False, MIN_REACH), (True, MIN_TILTED_REACH)):
        group = [pose for pose in poses if (pose.tilt > LEVEL_TILT) == is_tilted]
        far = [pose for pose in group if not robot.reaches(pose)]
        if len(far) > (1.0 - least) * len(group):
            x, y, z = far[0].position
            takes = (
                f"one of which robot={config.robot!r} reaches at least {least:.0%} with "
                f"{'a tilted' if is_tilted else 'an upright'} gripper; it reaches "
                f"{1.0 - len(far) / len(group):.0%}, for example not ({x:g}, {y:g}, {z:g})"
            )
            raise ParameterError.of("workspace", config.workspace, takes)


def grid_positions(config: EnvConfig, heights: Iterable[float], points: int = POINTS) -> Iterator[Vector]:
    """Yield positions (m) on a grid over the workspace, ``points`` along each side, at some heights (m)."""
    xs, ys = (np.linspace(low, high, points).tolist() for low, high in config.workspace[:2])
    return itertools.product(xs, ys, heights)
