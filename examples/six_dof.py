r"""Closed-loop control of all six degrees of freedom: translation, rotation vector and opening.

cd examples
python -m bulletarm_gym.check BulletArm/CloseLoopBlockPicking-v0 -n 50 \
    --gym-packages six_dof --env-kwargs control:six_dof
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

import bulletarm_gym
from bulletarm_gym.control import CloseLoop, Outcome
from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.observations import View
from bulletarm_gym.tasks import Waypoint

TILT = math.pi / 3
"""Largest tilt (rad) of the gripper."""
ANGLES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class PoseMove:
    """Opening ratio, translation (m) and rotation vector (rad) along the world's x, y and z axes."""

    opening: float
    translation: Vector
    rotation: Vector


class SixDof(CloseLoop):
    """Delta-pose control with the actions dx, dy, dz and a rotation vector."""

    sequences = ("pxyzrrr",)
    max_rotation = math.pi / 8

    @property
    def names(self) -> list[str]:
        """Name of each number of an action: the r's are angles in their order."""
        angles = iter(ANGLES)
        return [next(angles) if character == "r" else character for character in self.sequence]

    def decode_action(self, action: ArrayLike, view: View) -> PoseMove:
        """Return the move of an action."""
        value = dict(zip(self.names, self.numbers(action), strict=True))
        translation = tuple(self.max_translation * value[axis] for axis in "xyz")
        rotation = tuple(self.max_rotation * value[angle] for angle in ANGLES)
        return PoseMove((value["p"] + 1) / 2, translation, rotation)

    def encode_action(self, move: PoseMove) -> NDArray[np.float32]:
        """Return the action of a move."""
        value = {"p": 2 * move.opening - 1}
        value |= zip("xyz", np.divide(move.translation, self.max_translation), strict=True)
        value |= zip(ANGLES, np.divide(move.rotation, self.max_rotation), strict=True)
        return np.array([value[name] for name in self.names], dtype=np.float32).clip(-1, 1)

    def apply(self, move: PoseMove) -> Outcome:
        """Execute a move; beyond the largest tilt the gripper does not rotate."""
        tool = self.robot.pose
        position = self.within(np.add(tool.position, move.translation).tolist())
        rotation = Rotation.from_rotvec(move.rotation) * Rotation.from_quat(tool.orientation)
        pose = Pose(position, tuple(rotation.as_quat().tolist()))
        return self.go(pose if pose.tilt < TILT else Pose(position, tool.orientation), move.opening)

    def towards(self, waypoint: Waypoint) -> PoseMove:
        """Return the move of the expert towards a waypoint."""
        tool, goal, step = self.robot.pose, waypoint.pose, self.max_translation
        path = np.subtract(self.within(goal.position), tool.position)
        start, end = map(Rotation.from_quat, (tool.orientation, goal.orientation))
        rotation = (end * start.inv()).as_rotvec()
        excess = max(np.abs(path).max() / step, np.abs(rotation).max() / self.max_rotation, 1.0)
        path = path / excess if waypoint.straight else path.clip(-step, step)
        arrives = excess < 1.001 and waypoint.finish is not None
        opening = waypoint.finish if arrives else waypoint.gripper
        return PoseMove(opening, tuple(path.tolist()), tuple((rotation / excess).tolist()))


bulletarm_gym.register_control("six_dof", SixDof)
bulletarm_gym.register_task("BlockPicking", "bulletarm_gym.tasks.picking:BlockPicking", control="six_dof")
