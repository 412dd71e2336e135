"""Experts: plans of waypoints that solve tasks, and moves that follow them."""

from dataclasses import dataclass

from bulletarm_gym.config_checks import check_fields, fraction, optional
from bulletarm_gym.geometry import Pose
from bulletarm_gym.geometry.poses import pose_check

OPEN = 1.0
HALF_OPEN = 0.5
CLOSED = 0.0


@dataclass(frozen=True)
class Waypoint:
    """A pose of the fingertips in a plan (paper, Expert Demonstrations).

    Closed-loop control moves from one waypoint to the next. Open-loop control executes the first waypoint
    with a ``finish``: a pick if that closes the gripper, a place if it opens it. For a task of both controls,
    closed-loop control adds the path to such a pick or place.

    :param pose: pose of the fingertips in the world
    :param gripper: opening ratio before arrival, 0 closed to 1 open
    :param finish: opening ratio on arrival; None keeps ``gripper``
    :param straight: move in a straight line, for moves in contact; otherwise each axis moves at its own limit
    :param clear: the space in between is free, so that closed-loop control adds no path
    """

    pose: Pose
    gripper: float
    finish: float | None = None
    straight: bool = False
    clear: bool = False

    def __post_init__(self) -> None:
        check_fields(self, {"pose": pose_check, "gripper": fraction, "finish": optional(fraction)})
