"""Description of an arm with its gripper."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.config_checks import check_fields, function, instance, numbers
from bulletarm_gym.geometry import FloatArray, Pose, matrix
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.geometry.poses import pose_check
from bulletarm_gym.robots.editing import DARK, check_element, cylinder
from bulletarm_gym.robots.gripper import JOINTS, Gripper
from bulletarm_gym.robots.kinematics import Chain, Frames, advance, apply, dot, product
from bulletarm_gym.robots.structure import prepare
from bulletarm_gym.simulation import Body
from bulletarm_gym.simulation.urdf import find, find_root, to_text
from bulletarm_gym.simulation.world import GRAVITY, TIME_STEP

PLINTH_RADIUS = 0.09
"""Radius (m) of the stand under an arm whose base is above the ground, outside the workspaces."""
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
    :param base: pose of the arm's base in the world
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
        checks = {"name": instance(str), "load": function, "joints": JOINTS, "gripper": instance(Gripper)}
        check_fields(self, {**checks, "tool": pose_check, "base": pose_check})
        several = len(self.joints) if np.iterable(self.force) else None
        posture, force = numbers("finite", len(self.joints)), numbers("positive", several)
        check_fields(self, {"posture": posture, "force": force})

    @cached_property
    def urdf(self) -> Element:
        """The URDF on a plinth, without fixed joints.

        Joints that are neither the arm's nor the fingers' are fixed at 0, or at their limit nearest to 0.

        :raises ValueError: the model cannot be simulated, see :mod:`bulletarm_gym.robots.structure`
        """
        root = self.load()
        try:
            check_element("load()", root)
            root = copy.deepcopy(root)  # another model may load the same element
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
        lengths = np.linspace(0.0, reach, 1000)[:, None]
        line = base - lengths * [math.cos(self.base.yaw), math.sin(self.base.yaw)]
        return bool(((low < line) & (line < high)).all(axis=1).any())

    @cached_property
    def _directions(self) -> tuple[float, float]:
        """Direction of rotation about the vertical by the first and the last joint: 1, -1 or 0."""
        vertical = self.chain.derivatives(np.array(self.posture))[2][5]
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
            find(root, "joint", name).set("type", "continuous")
        return to_text(root)


Model = tuple[Frames, FloatArray, FloatArray, FloatArray]
"""Frames of a chain; masses, centres and inertias of its links and of the tool, which has a joint at 0."""

TORQUE_SHARE = 0.9
"""Fraction of the maximum torque for motions in free space. The rest is for contacts."""
MIN_ACCELERATION_SHARE = 0.1
"""Minimum fraction of the torque for acceleration, even if gravity takes more than the rest."""
MAX_STEPS = 480
"""Maximum number of simulation steps of a motion (2 s)."""


class Dynamics:
    """Inverse dynamics of a loaded arm. Fingers and grasped object are a point mass at the tool.

    :param joints: indices of the chain's joints in Bullet
    """

    def __init__(self, arm: Body, joints: Sequence[int], chain: Chain) -> None:
        moved = [arm.links[joint] for joint in joints]
        tip = {joints[-1]}
        for index, link in enumerate(arm.links):  # a link comes after its parent
            if link.parent in tip:
                tip.add(index)
        tip_mass = sum(arm.links[index].mass for index in sorted(tip - {joints[-1]}))
        axes = [matrix(link.frame) for link in moved]
        inertias = [axis @ np.diag(link.inertia) @ axis.T for axis, link in zip(axes, moved, strict=True)]
        self._masses = np.array([*(link.mass for link in moved), tip_mass])
        self._centres = np.array([*(link.frame.position for link in moved), (0.0, 0.0, 0.0)])
        self._inertias = np.array([*inertias, np.zeros((3, 3))])
        self._frames = (*chain.frames[:2], np.vstack([chain.frames[2], (0.0, 0.0, 1.0)]))

    def torques(
        self, positions: FloatArray, rates: FloatArray, accelerations: FloatArray, load: float = 0.0
    ) -> FloatArray:
        """Return the joint torques (n,) N m of a motion under gravity with a load (kg) in the gripper.

        Positions, rates and accelerations are (n,) in rad, rad/s and rad/s^2.
        """
        motion = [np.append(values, 0.0) for values in (positions, rates, accelerations)]
        torques: FloatArray = _torques(self._model(load), *motion)[:-1]
        return torques

    def least_steps(self, path: FloatArray, limits: FloatArray, load: float, rise: float) -> int:
        """Return the minimum number of simulation steps of a motion along a path.

        The torque is the static torque plus a part inversely proportional to the square of the duration. Both
        are computed at the start, at the maximum speed and at the end, where torques are largest.

        :param path: (k, n) joint positions (rad) at equal distances along the path
        :param limits: (n,) maximum torques (N m)
        :param load: mass (kg) of the grasped object
        :param rise: fraction of the motion with positive acceleration
        """
        rising, braking = 2.0 / rise, -2.0 / (1.0 - rise)  # of a motion of length 1 in one second
        # Share of the path, speed and acceleration.
        phases = ((0.0, 0.0, rising), (rise, 2.0, rising), (rise, 2.0, braking), (1.0, 0.0, braking))
        path = np.column_stack([path, np.zeros(len(path))])
        square = _least_square(self._model(load), path, TORQUE_SHARE * limits, np.array(phases))
        return min(math.ceil(math.sqrt(square) / TIME_STEP), MAX_STEPS)

    def _model(self, load: float) -> Model:
        masses = self._masses.copy()
        masses[-1] += load
        return self._frames, masses, self._centres, self._inertias


@compiled
def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@compiled
def _acceleration(linear: FloatArray, alpha: FloatArray, omega: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the linear acceleration of a rotating body at an offset (m)."""
    found: FloatArray = linear + _cross(alpha, offset) + _cross(omega, _cross(omega, offset))
    return found


@compiled
def _torques(model: Model, positions: FloatArray, rates: FloatArray, accelerations: FloatArray) -> FloatArray:
    """Return the torques (n + 1,) N m by the recursive Newton-Euler algorithm, in world coordinates."""
    frames, masses, centres, inertias = model
    n = len(positions)
    rotation, origin, spare = np.eye(3), np.zeros(3), np.empty((2, 3, 3))
    omega, alpha, linear = np.zeros(3), np.zeros(3), np.array((0.0, 0.0, -GRAVITY))
    origins, axes, torques = np.empty((n, 3)), np.empty((n, 3)), np.zeros(n)
    arm, spin, moment = np.empty(3), np.empty(3), np.empty(3)
    for j in range(n):
        before = origin.copy()
        advance(rotation, origin, frames, j, positions[j], spare)
        linear = _acceleration(linear, alpha, omega, origin - before)
        apply(rotation, frames[2][j], axes[j])
        alpha = alpha + axes[j] * accelerations[j] + _cross(omega, axes[j] * rates[j])
        omega = omega + axes[j] * rates[j]
        apply(rotation, centres[j], arm)
        force = masses[j] * _acceleration(linear, alpha, omega, arm)
        product(rotation, inertias[j], spare[0])
        product(spare[0], rotation.T, spare[1])
        apply(spare[1], omega, spin)
        apply(spare[1], alpha, moment)
        moment += _cross(omega, spin)
        origins[j] = origin
        for k in range(j + 1):
            torques[k] += dot(axes[k], moment + _cross(origin + arm - origins[k], force))
    return torques


@compiled
def _least_square(model: Model, path: FloatArray, limits: FloatArray, phases: FloatArray) -> float:
    """Return the square of the shortest duration (s) of a motion with (k, 3) phases along a path."""
    pieces, still, square = len(path) - 1, np.zeros(path.shape[1]), 0.0
    for phase in range(len(phases)):
        share, rate, acceleration = phases[phase]
        piece = min(int(share * pieces), pieces - 1)
        slope = (path[piece + 1] - path[piece]) * pieces
        here = path[piece] + slope * (share - piece / pieces)
        static = _torques(model, here, still, still)
        total = _torques(model, here, slope * rate, slope * acceleration)
        for j in range(len(limits)):
            room = max(limits[j] - abs(static[j]), MIN_ACCELERATION_SHARE * limits[j])
            square = max(square, abs(total[j] - static[j]) / room)
    return square
