"""Description of an arm with its gripper."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.robots.editing import check_element
from bulletarm_gym.robots.gripper import Gripper, set_numbers
from bulletarm_gym.robots.kinematics import Chain
from bulletarm_gym.robots.primitives import DARK, cylinder
from bulletarm_gym.robots.structure import prepare
from bulletarm_gym.simulation.urdf import find_joint, find_root, to_text

PLINTH_RADIUS = 0.09
"""Radius (m) of the stand under an arm whose base is above the ground, outside the workspaces."""
LINE_POINTS = 1000
"""Number of points of the line behind the base in the test of a workspace."""
VERTICAL = 0.9
"""Minimum cosine between the vertical and the axis of a joint that rotates the gripper about the vertical."""


@dataclass(frozen=True)
class RobotModel:
    """An arm and its gripper.

    :param name: value of the parameter ``robot``
    :param load: function that returns the URDF of the arm with its gripper, see
        :func:`~bulletarm_gym.robots.read_urdf`
    :param joints: names of the revolute joints, from the base to the gripper
    :param tool: tool frame between the fingertips in the link of the last joint; z points back to the arm, x
        is the opening direction
    :param gripper: the gripper in the URDF
    :param base: pose of the arm's base in the world; ``tools/reach.py`` compares the reach of bases
    :param posture: joint positions (rad) from which inverse kinematics starts: gripper down, elbow up, in
        front of the base
    :param force: maximum torque (N m) of each joint, or one value for all joints
    :raises ValueError: a value has another type or length, or a number is not finite or not positive
    """

    name: str
    load: Callable[[], Element]
    joints: tuple[str, ...]
    tool: Pose
    gripper: Gripper
    base: Pose
    posture: tuple[float, ...]
    force: float | tuple[float, ...]

    def __post_init__(self) -> None:
        """Check the values and convert sequences to tuples."""
        object.__setattr__(self, "joints", tuple(self.joints))
        set_numbers(self, "posture", (len(self.joints),), "finite")
        set_numbers(self, "force", (len(self.joints),) if np.ndim(self.force) else ())

    @cached_property
    def urdf(self) -> Element:
        """The URDF on a plinth, without fixed joints.

        Joints that are neither the arm's nor the fingers' are fixed at 0, or at their limit nearest to 0.

        :raises ValueError: the model cannot be simulated, see :mod:`bulletarm_gym.robots.structure`
        """
        root = self.load()
        try:
            check_element("load()", root)
            prepare(root, self.joints, self.gripper, self.tool)
        except ValueError as error:
            raise ValueError(f"robot {self.name!r}: {error}") from error
        if self.base.z > 0.0:
            # Not solid, because ramps reach under the arm, and a robot in contact moves by simulation only.
            plinth = cylinder(PLINTH_RADIUS, self.base.z, (0.0, 0.0, -self.base.z / 2.0), DARK, solid=False)
            plinth.add_to(find_root(root))
        return root

    @cached_property
    def chain(self) -> Chain:
        """Kinematics from the world to the fingertips.

        :raises ValueError: ``posture`` is outside the joint limits
        """
        chain = Chain.from_urdf(self.urdf, self.joints, self.base, self.tool)
        for name, position, (lower, upper) in zip(self.joints, self.posture, chain.limits, strict=True):
            if not lower <= position <= upper:
                raise ValueError(
                    f"robot {self.name!r}: posture must be inside the joint limits, got {position:g} rad "
                    f"for {name!r} with the limits {lower:g} and {upper:g} rad"
                )
        return chain

    @property
    def torques(self) -> tuple[float, ...]:
        """Maximum torque (N m) of each joint."""
        return self.force if isinstance(self.force, tuple) else (self.force,) * len(self.joints)

    def inverse(self, pose: Pose) -> tuple[FloatArray, float]:
        """Return joint positions (n,) rad for a tool pose, and the remaining error (m or rad).

        The first iteration leads from the posture to the distance and height of the pose in front of the base
        with an upright gripper, the second one to the pose. Neighbouring poses have neighbouring solutions,
        and the result depends on the pose alone.
        """
        x, y, yaw = pose.x - self.base.x, pose.y - self.base.y, self.base.yaw
        azimuth, radius = math.remainder(math.atan2(y, x) - yaw, math.tau), math.hypot(x, y)
        front = (self.base.x + radius * math.cos(yaw), self.base.y + radius * math.sin(yaw))
        upright = Pose.planar(*front, pose.z, yaw)
        start, _ = self.chain.inverse(upright, self._start.copy())
        first, last = self._directions
        start[0] += first * azimuth
        start[-1] += last * (pose.yaw - yaw - azimuth)
        return self.chain.inverse(pose, start)

    @cached_property
    def _start(self) -> FloatArray:
        """Posture (n,) rad, rotated about the base if it is behind it."""
        start, yaw = np.array(self.posture), self.base.yaw
        tool = self.chain.forward(start)
        azimuth = math.remainder(math.atan2(tool.y - self.base.y, tool.x - self.base.x) - yaw, math.tau)
        if abs(azimuth) > math.pi / 2.0:
            first, last = self._directions
            start[0] -= first * azimuth
            start[-1] += last * math.remainder(yaw + azimuth - tool.yaw, math.tau)
        return start

    def jumps_inside(self, workspace: Sequence[Sequence[float]]) -> bool:
        """Return True if the solution for the first joint is discontinuous in a workspace.

        It is discontinuous at the base, and at the line behind the base unless its range is 2 pi.

        :param workspace: [low, high] (m) along x and y
        """
        first, _ = self._directions
        lower, upper = self.chain.solution_limits[0]
        if first == 0.0:
            return False
        base, (low, high) = np.array(self.base.position[:2]), np.array(workspace[:2]).T
        reach = 0.0 if upper - lower >= math.tau else np.abs([base - low, base - high]).sum()
        lengths = np.linspace(0.0, reach, LINE_POINTS)[:, None]
        line = base - lengths * [math.cos(self.base.yaw), math.sin(self.base.yaw)]
        return bool(((low < line) & (line < high)).all(axis=1).any())

    @cached_property
    def _directions(self) -> tuple[float, float]:
        """Direction of rotation about the vertical by the first and the last joint: 1, -1 or 0."""
        vertical = self.chain.jacobian(np.array(self.posture))[5]
        first, last = np.where(np.abs(vertical) > VERTICAL, np.sign(vertical), 0.0)[[0, -1]].tolist()
        return first, last

    @cached_property
    def xml(self) -> str:
        """Text of the model for Bullet.

        Its arm joints are continuous joints with limits. Bullet clamps the targets of their motors, without a
        limit constraint, which takes a seventh of a simulation step.
        """
        root = copy.deepcopy(self.urdf)
        for name in self.joints:
            find_joint(root, name).set("type", "continuous")
        return to_text(root)
