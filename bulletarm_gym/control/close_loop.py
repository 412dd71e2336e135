"""Closed-loop control: each action moves the gripper by a small step (paper, Close-loop Environments)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import CLOSE_LOOP, MAX_ROTATION, MAX_TRANSLATION, EnvConfig
from bulletarm_gym.config_checks import check_argument, check_fields, instance, numbers
from bulletarm_gym.control.control import Control, GraspParams, Outcome, RobotInterface, grid_positions
from bulletarm_gym.geometry import Pose, Rectangle, Vector
from bulletarm_gym.observations import Frame, View

VIEW_SCALE = 1.5
"""Ratio of the observed square's side to the workspace's: 0.45 m for 0.3 m (paper, Benchmark Details)."""
CAMERA_OFFSET = 0.1
"""Height (m) of the virtual camera plane above the fingertips."""
FINGER_SQUARE = 0.021
"""Side (m) of the squares that show the fingers: 6 of 128 pixels over 0.45 m."""
YAW_OFFSETS = tuple(sign * step * MAX_ROTATION / 16.0 for step in range(33) for sign in (1.0, -1.0))
"""Offsets (rad) from the commanded yaw, smallest first, that are tried to stay inside the joint limits."""


@dataclass(frozen=True)
class DeltaMove:
    """A closed-loop action in physical units.

    :param opening: gripper opening ratio, 0 closed to 1 open
    :param translation: of the fingertips (m), along the world's axes
    :param rotation: of the gripper about z (rad)
    :raises ValueError: a number is not finite
    """

    opening: float
    translation: Vector
    rotation: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, {"opening": numbers(), "translation": numbers(count=3), "rotation": numbers()})


class CloseLoop(Control[DeltaMove]):
    """Delta-pose control.

    The characters of ``action_sequence`` are p, the opening (-1 closed, +1 open), x, y and z, the translation
    along the world's axes, and r, the rotation. Without r the gripper does not rotate.
    """

    kind = CLOSE_LOOP
    max_translation: ClassVar[float] = MAX_TRANSLATION
    """Largest translation (m) of an action along an axis."""
    max_rotation: ClassVar[float] = MAX_ROTATION
    """Largest rotation (rad) of an action."""

    def __init__(self, config: EnvConfig, robot: RobotInterface, grasp_params: GraspParams) -> None:
        positions = grid_positions(config, config.workspace[2])
        super().__init__(config, robot, (Pose.planar(*position) for position in positions))
        self._workspace = config.workspace
        self._extent = VIEW_SCALE * config.workspace_size
        limits = {**dict.fromkeys("xyz", self.max_translation), "r": self.max_rotation}
        self.ranges = {name: (-limit, limit) for name, limit in limits.items() if name in self.sequence}

    def decode_action(self, action: ArrayLike, view: View) -> DeltaMove:
        value = dict(zip(self.sequence, self.numbers(action), strict=True))
        x, y, z = (self.max_translation * value[axis] for axis in "xyz")
        return DeltaMove((value["p"] + 1.0) / 2.0, (x, y, z), self.max_rotation * value.get("r", 0.0))

    def encode_action(self, move: DeltaMove) -> NDArray[np.float32]:
        move = check_argument("move", move, instance(DeltaMove))
        value = dict(zip("xyz", (part / self.max_translation for part in move.translation), strict=True))
        value |= {"p": 2.0 * move.opening - 1.0, "r": move.rotation / self.max_rotation}
        return np.array([value[axis] for axis in self.sequence], dtype=np.float32).clip(-1.0, 1.0)

    def apply(self, move: DeltaMove) -> Outcome:
        """Execute a move: the arm first, then the gripper.

        At a joint limit the gripper moves to the nearest yaw inside the limits. A move to a position out of
        reach is ignored.
        """
        tool = self.robot.pose
        x, y, z = self.within(map(sum, zip(tool.position, move.translation, strict=True)))
        poses = (Pose.planar(x, y, z, tool.yaw + move.rotation + offset) for offset in YAW_OFFSETS)
        pose = next(filter(self.robot.can_move_to, poses), None)
        return Outcome(ignored=True) if pose is None else self._execute(pose, move.opening)

    def within(self, position: Iterable[float]) -> Vector:
        """Return the point (m) of the workspace nearest to a position."""
        limits = zip(position, self._workspace, strict=True)
        x, y, z = (min(max(value, low), high) for value, (low, high) in limits)
        return (x, y, z)

    def go(self, pose: Pose, opening: float) -> Outcome:
        """Move the fingertips to a pose, then the fingers to an opening ratio; ignored if out of reach."""
        return self._execute(pose, opening) if self.robot.can_move_to(pose) else Outcome(ignored=True)

    def _execute(self, pose: Pose, opening: float) -> Outcome:
        self.robot.move_to(pose, slides=True)
        self.robot.set_opening(opening)
        return Outcome(ignored=False)

    def frame(self) -> Frame:
        """Return the axis-aligned square around the fingertips, with the squares that show the fingers."""
        return tool_frame(self.robot.pose, self.robot.opening, self._extent)


def tool_frame(tool: Pose, opening: float, extent: float) -> Frame:
    """Return the observed square of side ``extent`` (m) around the fingertips.

    :param opening: distance (m) between the inner sides of the squares that show the fingers
    """
    offset = (opening + FINGER_SQUARE) / 2.0
    x, y = offset * math.cos(tool.yaw), offset * math.sin(tool.yaw)
    fingers = (
        Rectangle(tool.x + sign * x, tool.y + sign * y, FINGER_SQUARE, FINGER_SQUARE, tool.yaw)
        for sign in (1.0, -1.0)
    )
    return Frame(tool, extent, tool.z + CAMERA_OFFSET, tuple(fingers))
