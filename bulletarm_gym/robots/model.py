"""What an arm is, as data."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.config_checks import Check
from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.robots import checks
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.robots.kinematics import Chain, find_joint
from bulletarm_gym.robots.structure import check_chain, check_masses, check_opening, find_root, prepare
from bulletarm_gym.robots.urdf import DARK, add_parts, cylinder, merge_fixed

PLINTH_RADIUS = 0.09
"""Of the stand (m) under an arm whose base is above the ground; it stays clear of the workspaces."""
TRAVEL_TOLERANCE = 1e-4
"""Tolerance (m) of the comparison between the gripper's stroke and the fingers' joint limits."""
FRONT = math.pi / 2.0
"""Maximum angle (rad) about the base between the posture and the front. Beyond it the posture is rotated."""
LINE_POINTS = 1000
"""Number of points of the line behind the base that are compared with a workspace."""
VERTICAL = 0.9
"""Minimum cosine between the vertical and the axis of a joint that rotates the gripper about the vertical."""


@dataclass(frozen=True)
class RobotModel:
    """An arm and its gripper.

    :param name: the value of the parameter ``robot``
    :param load: reads or makes the URDF of the arm with its gripper, see
        :func:`~bulletarm_gym.robots.read_urdf`
    :param joints: names of the revolute joints, from the base to the gripper
    :param tool: the gripper's tool frame, between the fingertips, in the link that the last joint moves: z
        back towards the arm, x along which the fingers open
    :param gripper: the fingers in that model
    :param base: pose of the arm's base in the world; ``tools/reach.py`` compares bases by the share of both
        default workspaces that is in reach
    :param posture: joint positions (rad) from which inverse kinematics starts: gripper down, elbow up, in
        front of the base
    :param force: maximum torque (N m) of each joint, one value for each or one for all
    :raises ValueError: a value is of another type, or a number is not finite or not positive
    """

    name: str
    load: Callable[[], ElementTree.Element]
    joints: tuple[str, ...]
    tool: Pose
    gripper: Gripper
    base: Pose
    posture: tuple[float, ...]
    force: float | tuple[float, ...]

    def __post_init__(self) -> None:
        """Check the values, and keep sequences as tuples."""
        fields: dict[str, Check] = {
            "load": checks.function,
            "joints": checks.names(),
            "tool": checks.instance(Pose),
            "gripper": checks.instance(Gripper),
            "base": checks.instance(Pose),
            "posture": checks.numbers("numbers (rad), one for each joint"),
            "force": checks.torques,
        }
        checks.check_fields(self, f"robot {self.name!r}: ", fields)

    @cached_property
    def urdf(self) -> ElementTree.Element:
        """The model on its plinth, without fixed joints.

        Joints that are neither the arm's nor the fingers' are fixed at 0, or at their limit nearest to 0.

        :raises ValueError: a joint is missing or of a wrong type, the joints are not a chain, or a finger's
            joint limits do not allow the gripper's stroke
        """
        root = self.load()
        try:
            checks.check_element("load()", root)
            prepare(root, self.joints, self.gripper.joints)
            merge_fixed(root)
            check_chain(root, self.joints, self.gripper.joints)
            check_masses(root)
            check_opening(root, self.gripper.joints[0], self.tool)
        except ValueError as error:
            raise ValueError(f"robot {self.name!r}: {error}") from error
        for name in self.gripper.joints:
            self._check_travel(find_joint(root, name))
        if self.base.z > 0.0:
            # Only seen: ramps reach under the arm, and what touches something cannot be moved at once.
            plinth = cylinder(PLINTH_RADIUS, self.base.z, (0.0, 0.0, -self.base.z / 2.0), DARK, solid=False)
            add_parts(find_root(root), [plinth])
        return root

    def _check_travel(self, finger: ElementTree.Element) -> None:
        """Compare what the gripper says with what the model lets a finger do."""
        limit = finger.find("limit")
        upper = math.inf if limit is None else float(limit.get("upper", "0"))
        if upper < self.gripper.travel - TRAVEL_TOLERANCE:
            raise ValueError(
                f"robot {self.name!r}: the gripper's stroke of {self.gripper.stroke:g} m takes each finger "
                f"{self.gripper.travel:g} m, but {finger.get('name')!r} ends at {upper:g} m in the model"
            )

    @cached_property
    def chain(self) -> Chain:
        """Kinematics from the world to the fingertips.

        :raises ValueError: ``posture`` or ``force`` does not have one value for each joint, or a joint of
            ``posture`` is beyond its limits
        """
        chain = Chain.from_urdf(self.urdf, self.joints, self.base, self.tool)
        self._check_count("posture", self.posture)
        self._check_count("force", self.torques)
        for name, position, (lower, upper) in zip(self.joints, self.posture, chain.limits, strict=True):
            if not lower <= position <= upper:
                raise ValueError(
                    f"robot {self.name!r}: posture must be inside the joint limits, got {position:g} rad "
                    f"for {name!r} with the limits {lower:g} and {upper:g} rad"
                )
        return chain

    def _check_count(self, parameter: str, values: tuple[float, ...]) -> None:
        if len(values) != len(self.joints):
            raise ValueError(
                f"robot {self.name!r}: {parameter} must have {len(self.joints)} values, one for each joint, "
                f"got {len(values)}"
            )

    @property
    def torques(self) -> tuple[float, ...]:
        """Maximum torque (N m) of each joint."""
        return self.force if isinstance(self.force, tuple) else (self.force,) * len(self.joints)

    def inverse(self, pose: Pose) -> tuple[FloatArray, float]:
        """Return joint positions (n,) rad for a fingertip pose, and the remaining error (m or rad).

        The search starts from the posture, goes to the same distance and height in front of the base with an
        upright gripper, and from there to the pose. Neighbouring poses have neighbouring solutions, and the
        result depends on the pose alone.
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

    def jumps_inside(self, workspace: Sequence[Sequence[float]]) -> bool:
        """Return True if the first joint jumps between neighbouring positions in a workspace.

        It jumps around the base, and on both sides of the line behind the base unless the first joint makes a
        whole turn.

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
    def _start(self) -> FloatArray:
        """Posture (n,) rad. If it is more than :data:`FRONT` from the front, it is rotated about the base."""
        start, yaw = np.array(self.posture), self.base.yaw
        tool = self.chain.forward(start)
        azimuth = math.remainder(math.atan2(tool.y - self.base.y, tool.x - self.base.x) - yaw, math.tau)
        if abs(azimuth) > FRONT:
            first, last = self._directions
            start[0] -= first * azimuth
            start[-1] += last * math.remainder(yaw + azimuth - tool.yaw, math.tau)
        return start

    @cached_property
    def _directions(self) -> tuple[float, float]:
        """Sense in which the first and the last joint rotate the gripper about the vertical, 1, -1 or 0."""
        vertical = self.chain.jacobian(np.array(self.posture))[5]
        first, last = np.where(np.abs(vertical) > VERTICAL, np.sign(vertical), 0.0)[[0, -1]].tolist()
        return first, last

    @cached_property
    def xml(self) -> str:
        """The model as the simulator loads it.

        Its arm joints are continuous joints with limits: Bullet clamps the targets of their motors, but
        adds no limit constraint, which would cost a seventh of a simulation step.
        """
        root = copy.deepcopy(self.urdf)
        for name in self.joints:
            find_joint(root, name).set("type", "continuous")
        ElementTree.indent(root)  # Bullet breaks lines of more than 1,023 characters, wherever that is
        return ElementTree.tostring(root, encoding="unicode")
