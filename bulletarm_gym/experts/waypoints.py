"""What experts plan in: places for the fingertips, and what the gripper does on the way."""

from dataclasses import dataclass

from bulletarm_gym.geometry import Pose

OPEN = 1.0
HALF_OPEN = 0.5
CLOSED = 0.0


@dataclass(frozen=True)
class Waypoint:
    """A place an expert wants the fingertips at (paper, Expert Demonstrations).

    Close-loop control goes from one to the next. Open-loop control finds its own way: of a plan it takes the
    first waypoint with a ``finish``, as a pick if that closes the gripper, as a place if it opens it. To such
    picks and places of a task for both controls close-loop control finds a way, too.

    :param pose: of the fingertips, in the world
    :param gripper: opening ratio on the way, 0 closed to 1 open
    :param finish: opening ratio on arrival; None keeps that of the way
    :param straight: come in a straight line, for moves in contact; else each axis runs at its own limit
    :param clear: nothing is in between: close-loop control can go there as it is
    """

    pose: Pose
    gripper: float
    finish: float | None = None
    straight: bool = False
    clear: bool = False
