"""Forward and inverse kinematics of a serial arm with joint limits.

PyBullet's inverse kinematics takes 0.3 to 0.5 ms for an error of 0.1 mm, and its result depends on the
current joint positions. The damped Newton iteration here takes 20 microseconds from a fixed start, and its
solution depends on the pose alone. The null space of a redundant arm keeps the joints inside their limits.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose, matrix, quaternion
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.simulation.urdf import axis_of, find, frame_of, limits_of

MAX_ITERATIONS = 80
TOLERANCE = 1e-9
"""Error (m and rad) below which the iteration stops."""
DAMPING = 1e-8
"""Damping of the least-squares steps (m^2 and rad^2)."""
MAX_JOINT_STEP = 0.4
"""Maximum change (rad) of a joint in an iteration, so that the solution stays on the branch of the start."""
MAX_NULL_STEP = 0.3
"""Maximum change (rad) of a joint in an iteration towards its limits."""
POSITION_TOLERANCE = 1e-4
"""Error (m or rad) above which a pose is out of reach."""
LIMIT_MARGIN = 0.02
"""Minimum distance (rad) of solutions from the joint limits, because contacts may push a joint further."""
HALF_TURN_SINE = 1e-6
"""Sine of a rotation angle below which the symmetric part of the matrix gives the rotation axis."""

Frames = tuple[FloatArray, FloatArray, FloatArray]
"""Rotations, translations and axes of a chain."""


@dataclass(frozen=True)
class Chain:
    """Revolute joints from the world to a tool.

    :param frames: (n + 1, 3, 3) fixed rotations and (n + 1, 3) fixed offsets (m) before each joint and before
        the tool; (n, 3) unit axis of each joint in its own frame
    :param limits: (n, 2) lower and upper limit (rad) of each joint, infinite for a continuous joint
    """

    frames: Frames
    limits: FloatArray

    @classmethod
    def from_urdf(cls, root: Element, joints: Sequence[str], base: Pose, tool: Pose) -> "Chain":
        """Return the chain of named joints of a URDF and a tool frame in the last link."""
        elements = [find(root, "joint", name) for name in joints]
        first, *others = map(frame_of, elements)
        poses, axes = [base.compose(first), *others, tool], np.array([*map(axis_of, elements)])
        frames = (
            np.stack([matrix(pose) for pose in poses]),
            np.array([pose.position for pose in poses]),
            np.array([axis / np.linalg.norm(axis) for axis in axes]),
        )
        return cls(frames, np.array([*map(limits_of, elements)]))

    def forward(self, joints: FloatArray) -> Pose:
        """Return the tool's pose in the world at joint positions (n,) rad."""
        rotation, position, _ = self.derivatives(joints)
        x, y, z = position.tolist()
        return Pose((x, y, z), quaternion(rotation))

    def derivatives(self, joints: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the tool's rotation (3, 3) and position (3,) m in the world, and their Jacobian (6, n)."""
        return _derivatives(self.frames, np.asarray(joints, np.float64))

    def inverse(self, pose: Pose, start: FloatArray) -> tuple[FloatArray, float]:
        """Return joint positions (n,) rad for a tool pose, and the maximum error.

        The error is that of the position (m), of the rotation (rad), or beyond a joint limit (rad).

        :param start: joint positions (n,) rad at the start of the iteration
        """
        target = (matrix(pose), np.array(pose.position))
        return _inverse(self.frames, self.solution_limits, target, start)

    @cached_property
    def solution_limits(self) -> FloatArray:
        """Limits (n, 2) rad of solutions: the joint limits minus :data:`LIMIT_MARGIN`."""
        lower, upper = self.limits.T
        margin = np.minimum(LIMIT_MARGIN, (upper - lower) / 2.0)
        return np.stack([lower + margin, upper - margin], axis=1)


@compiled
def apply(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """Write ``m @ v``."""
    for i in range(3):
        out[i] = m[i, 0] * v[0] + m[i, 1] * v[1] + m[i, 2] * v[2]


@compiled
def product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write ``a @ b`` to an array that is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@compiled
def advance(
    rotation: FloatArray, position: FloatArray, frames: Frames, joint: int, angle: float, spare: FloatArray
) -> None:
    """Replace the frame before a joint by the frame after it.

    :param spare: memory for two rotations, (2, 3, 3)
    """
    rotations, translations, axes = frames
    apply(rotation, translations[joint], spare[0, 0])
    position += spare[0, 0]
    product(rotation, rotations[joint], spare[0])
    turned, (x, y, z), c, s = spare[1], axes[joint], math.cos(angle), math.sin(angle)
    t = 1.0 - c
    turned[0, 0], turned[0, 1], turned[0, 2] = t * x * x + c, t * x * y - s * z, t * x * z + s * y
    turned[1, 0], turned[1, 1], turned[1, 2] = t * x * y + s * z, t * y * y + c, t * y * z - s * x
    turned[2, 0], turned[2, 1], turned[2, 2] = t * x * z - s * y, t * y * z + s * x, t * z * z + c
    product(spare[0], turned, rotation)


@compiled
def _derivatives(frames: Frames, joints: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the tool's rotation and position, and the (6, n) Jacobian of position and rotation (world)."""
    rotations, translations, axes = frames
    n = len(joints)
    rotation, position, jacobian = np.eye(3), np.zeros(3), np.empty((6, n))
    origins, spare, tool = np.empty((n, 2, 3)), np.empty((2, 3, 3)), np.empty((3, 3))
    for j in range(n):
        advance(rotation, position, frames, j, joints[j], spare)
        origins[j, 0] = position
        apply(rotation, axes[j], origins[j, 1])
    apply(rotation, translations[-1], spare[0, 0])
    position += spare[0, 0]
    product(rotation, rotations[-1], tool)
    for j in range(n):
        axis, (x, y, z) = origins[j, 1], position - origins[j, 0]
        jacobian[0, j] = axis[1] * z - axis[2] * y
        jacobian[1, j] = axis[2] * x - axis[0] * z
        jacobian[2, j] = axis[0] * y - axis[1] * x
        jacobian[3:, j] = axis
    return tool, position, jacobian


@compiled
def _rotation_vector(goal: FloatArray, now: FloatArray) -> FloatArray:
    """Return the rotation vector (rad, world) from ``now`` to ``goal``."""
    r = np.empty((3, 3))
    product(goal, now.T, r)
    vector: FloatArray = np.array((r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])) / 2.0
    sine, cosine = math.sqrt(dot(vector, vector)), (r[0, 0] + r[1, 1] + r[2, 2] - 1.0) / 2.0
    angle = math.atan2(sine, cosine)
    if sine > HALF_TURN_SINE:
        vector *= angle / sine
    elif cosine < 0.0:  # the antisymmetric part of the matrix is 0, and the symmetric part gives the axis
        column = np.argmax(np.diag(r))
        norm = math.sqrt(2.0 * (r[column, column] + 1.0))
        vector = (r[:, column] + np.eye(3)[column]) * angle / norm
    return vector


@compiled
def dot(a: FloatArray, b: FloatArray) -> float:
    """Return the scalar product, summed in order."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _solve(a: FloatArray, x: FloatArray, low: FloatArray) -> None:
    """Replace ``x`` by the solution of ``a @ y = x``; ``low`` is memory for the Cholesky decomposition."""
    n = len(x)
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j] - dot(low[i, :j], low[j, :j])
            low[i, j] = math.sqrt(s) if i == j else s / low[j, j]
    for i in range(n):
        x[i] = (x[i] - dot(low[i, :i], x[:i])) / low[i, i]
    for i in range(n - 1, -1, -1):
        x[i] = (x[i] - dot(low[i + 1 :, i], x[i + 1 :])) / low[i, i]


@compiled
def _beyond(joints: FloatArray, limits: FloatArray) -> FloatArray:
    """Return the change (n,) rad that moves each joint inside its limits."""
    change: FloatArray = np.minimum(np.maximum(joints, limits[:, 0]), limits[:, 1]) - joints
    return change


@compiled
def _null_step(jacobian: FloatArray, square: FloatArray, beyond: FloatArray, low: FloatArray) -> FloatArray:
    """Return the step (n,) in the null space that moves joints towards their limits."""
    weights, step = np.empty(6), beyond.copy()
    for i in range(6):
        weights[i] = dot(jacobian[i], beyond)
    _solve(square, weights, low)
    for i in range(6):
        step -= jacobian[i] * weights[i]
    moved = beyond != 0.0
    wanted, norm = dot(beyond[moved], step[moved]), dot(step[moved], step[moved])
    step *= min(wanted / norm, MAX_NULL_STEP / np.abs(step).max()) if norm >= 1e-12 else 0.0
    return step


@compiled
def _unwind(joints: FloatArray, limits: FloatArray, beyond: FloatArray) -> None:
    """Add multiples of 2 pi to joints outside their limits if the result is inside."""
    for j in range(len(joints)):
        turns = math.ceil(abs(beyond[j]) / (2.0 * math.pi))
        turned = joints[j] + math.copysign(2.0 * math.pi * turns, beyond[j])
        if limits[j, 0] <= turned <= limits[j, 1]:
            joints[j] = turned


@compiled
def _inverse(
    frames: Frames, limits: FloatArray, target: tuple[FloatArray, FloatArray], start: FloatArray
) -> tuple[FloatArray, float]:
    """Return joint positions (n,) rad for a rotation (3, 3) and position (3,), and the maximum error."""
    n = len(start)
    joints, error, square, low = start.copy(), np.empty(6), np.empty((6, 6)), np.zeros((6, 6))
    for iteration in range(MAX_ITERATIONS + 1):
        rotation, position, jacobian = _derivatives(frames, joints)
        error[:3], error[3:] = target[1] - position, _rotation_vector(target[0], rotation)
        beyond = _beyond(joints, limits)
        is_solved = dot(error, error) < TOLERANCE**2
        if is_solved and beyond.any():
            _unwind(joints, limits, beyond)
            beyond = _beyond(joints, limits)
        outside = np.abs(beyond).max()
        if iteration == MAX_ITERATIONS or (is_solved and (outside < TOLERANCE or n <= 6)):
            break
        for i in range(6):
            for j in range(i + 1):  # the solver reads the lower triangle
                square[i, j] = dot(jacobian[i], jacobian[j])
            square[i, i] += DAMPING
        weights, change = error.copy(), np.zeros(n)
        _solve(square, weights, low)
        for i in range(6):
            change += jacobian[i] * weights[i]
        if outside > 0.0 and n > 6:
            change += _null_step(jacobian, square, beyond, low)
        joints += change * min(1.0, MAX_JOINT_STEP / max(np.abs(change).max(), 1e-12))
    return joints, max(np.abs(error).max(), outside)
