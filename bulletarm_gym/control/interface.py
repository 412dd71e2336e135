"""Interface of a robot for controls."""

from collections.abc import Callable, Sequence

from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import Robot


class RobotInterface:
    """Commands and measurements of a robot, without the poses of objects.

    Poses are of the fingertips in the world (m).

    :param robot: the simulated robot
    :param settle: function that simulates until loose objects are at rest
    """

    def __init__(self, robot: Robot, settle: Callable[[], None]) -> None:
        self._robot = robot
        self._settle = settle

    @property
    def pose(self) -> Pose:
        """Measured pose of the fingertips."""
        return self._robot.pose

    @property
    def stroke(self) -> float:
        """Largest distance (m) between the fingers."""
        return self._robot.model.gripper.stroke

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

    def move_joints(self, positions: Sequence[float], in_contact: bool = True) -> None:
        """Move the arm joints to positions (rad). A blocked arm stops.

        :param in_contact: move slowly, because the robot may push an object
        :raises ValueError: the number of positions is wrong, or one is outside its limits
        """
        self._robot.move_joints(positions, in_contact)

    def reaches(self, pose: Pose) -> bool:
        """Return True if the inverse kinematics has a solution for a pose."""
        return self._robot.reaches(pose)

    def can_move_to(self, pose: Pose) -> bool:
        """Return True if one motion leads to a pose: in reach, no joint limit in between, almost straight."""
        return self._robot.can_move_to(pose)

    def reset(self, pose: Pose) -> None:
        """Set the empty, open gripper to a pose without moving through the space between.

        :raises OutOfReachError: the pose is out of reach
        """
        self._robot.home(pose)

    def move_to(self, pose: Pose, in_contact: bool = True) -> None:
        """Move to a pose; a blocked arm stops early.

        :param in_contact: move slowly where the gripper may push an object
        :raises OutOfReachError: the pose is out of reach
        """
        self._robot.move_to(pose, in_contact)

    def transfer(self, *poses: Pose) -> None:
        """Move, above everything in between, to the first pose that touches nothing, or to the last pose.

        :raises OutOfReachError: a pose is out of reach
        """
        self._robot.transfer(*poses)

    def set_opening(self, ratio: float) -> None:
        """Move the fingers to an opening ratio, 0 closed to 1 open; an object between them stops them."""
        self._robot.set_opening(ratio)

    def is_apart(self) -> bool:
        """Return True if the arm and the grasped object touch nothing else."""
        return self._robot.is_apart()

    def wait_until_still(self) -> None:
        """Wait until loose objects are at rest."""
        self._settle()
