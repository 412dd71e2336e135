"""Forward and inverse kinematics of a serial arm with joint limits.

PyBullet's own inverse kinematics needs 200 iterations and 0.3 to 0.5 ms for 0.1 mm, and its result depends
on the current joint positions. Here a damped Newton iteration starts from one fixed posture, takes some 20
microseconds, and always gives the same joint positions for a pose. The null space of a redundant arm keeps
the joints inside their limits.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose, Vector, euler_pose, matrix, quaternion
from bulletarm_gym.geometry.compilation import compiled

MAX_ITERATIONS = 80
TOLERANCE = 1e-9
"""Error (m and rad) at which the iteration stops."""
DAMPING = 1e-8
"""Damping of the least-squares steps (m^2 and rad^2)."""
MAX_JOINT_STEP = 0.4
"""Largest change (rad) of a joint in one iteration, which keeps the solution on the branch of its start."""
MAX_NULL_STEP = 0.3
"""Largest change (rad) of a joint in one iteration towards the joint limits."""
POSITION_TOLERANCE = 1e-4
"""Error (m or rad) above which a pose is out of reach."""
LIMIT_MARGIN = 0.02
"""Distance (rad) that solutions keep from the joint limits, so that contacts do not push a joint beyond."""
HALF_TURN_SINE = 1e-6
"""Sine of a rotation angle below which the rotation axis is read from the symmetric part of the matrix."""


@dataclass(frozen=True)
class Chain:
    """Revolute joints from the world to a tool.

    :param rotations: (n + 1, 3, 3) fixed rotation before each joint, and last before the tool
    :param translations: (n + 1, 3) fixed offset (m) before each joint, and last before the tool
    :param axes: (n, 3) unit axis of each joint in its own frame
    :param limits: (n, 2) lower and upper limit (rad) of each joint, infinite for a continuous joint
    """

    rotations: FloatArray
    translations: FloatArray
    axes: FloatArray
    limits: FloatArray

    @classmethod
    def from_urdf(cls, root: ElementTree.Element, joints: Sequence[str], base: Pose, tool: Pose) -> "Chain":
        """Read the chain of named joints; ``tool`` is given in the frame of the last link.

        :raises ValueError: the model has no joint of a name
        """
        elements = [find_joint(root, name) for name in joints]
        frames = [frame_of(element) for element in elements]
        frames = [base.compose(frames[0]), *frames[1:], tool]
        axes = [np.array(axis_of(element)) for element in elements]
        rotations = np.stack([matrix(frame) for frame in frames])
        axes = [axis / np.linalg.norm(axis) for axis in axes]
        limits = np.array([limits_of(element) for element in elements])
        return cls(rotations, np.array([f.position for f in frames]), np.array(axes), limits)

    def forward(self, joints: FloatArray) -> Pose:
        """Return the tool's pose in the world at joint positions (n,) rad."""
        rotation, position = _forward(
            self.rotations, self.translations, self.axes, np.asarray(joints, dtype=np.float64)
        )
        x, y, z = position.tolist()
        return Pose((x, y, z), quaternion(rotation))

    def jacobian(self, joints: FloatArray) -> FloatArray:
        """Return the derivative (6, n) of the tool's position (m) and rotation (rad, world) by the joints."""
        count = len(joints)
        jacobian, spare = np.empty((6, count)), np.empty((count + 3, 3, 3))
        chain = (self.rotations, self.translations, self.axes)
        _jacobian(*chain, np.asarray(joints, np.float64), np.empty((3, 3)), np.empty(3), jacobian, spare)
        return jacobian

    def inverse(self, pose: Pose, start: FloatArray) -> tuple[FloatArray, float]:
        """Solve for a pose from starting joint positions.

        :param pose: of the tool in the world
        :param start: (n,) rad
        :return: joint positions (n,) rad and the largest remaining error: of the position (m), of the
            rotation (rad) or beyond a joint limit (rad)
        """
        target = np.array(pose.position)
        limits = self.solution_limits
        return _inverse(self.rotations, self.translations, self.axes, limits, matrix(pose), target, start)

    @cached_property
    def solution_limits(self) -> FloatArray:
        """Limits (n, 2) rad that solutions keep: the joint limits less :data:`LIMIT_MARGIN`."""
        lower, upper = self.limits.T
        margin = np.minimum(LIMIT_MARGIN, (upper - lower) / 2.0)
        return np.stack([lower + margin, upper - margin], axis=1)


def frame_of(element: ElementTree.Element) -> Pose:
    """Return the ``origin`` of a URDF element in the frame it is given in."""
    origin = element.find("origin")
    return euler_pose(_floats(origin, "xyz", "0 0 0"), _floats(origin, "rpy", "0 0 0"))


def axis_of(joint: ElementTree.Element) -> Vector:
    """Return the axis of a URDF joint in its own frame, of any length."""
    return _floats(joint.find("axis"), "xyz", "1 0 0")


def limits_of(joint: ElementTree.Element) -> tuple[float, float]:
    """Return the lower and upper limit (rad or m) of a URDF joint, infinite for a continuous joint."""
    limit = joint.find("limit")
    if joint.get("type") == "continuous" or limit is None:
        return (-math.inf, math.inf)
    return (number_of(limit, "lower"), number_of(limit, "upper"))


def find_joint(root: ElementTree.Element, name: str) -> ElementTree.Element:
    """Return a joint.

    :raises ValueError: the model has none of that name
    """
    for joint in root.findall("joint"):  # not by XPath, in which a name cannot have quotes
        if joint.get("name") == name:
            return joint
    raise ValueError(f"the model has no joint {name!r}")


def number_of(element: ElementTree.Element, key: str, default: str = "0") -> float:
    """Return an attribute that is a number.

    :raises ValueError: it is not
    """
    text = element.get(key, default)
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{key} of <{element.tag}> must be a number, got {text!r}") from None


def _floats(element: ElementTree.Element | None, key: str, default: str) -> Vector:
    if element is None:
        element = ElementTree.Element("origin")
    text = element.get(key, default)
    try:
        x, y, z = (float(value) for value in text.split())
    except ValueError:
        raise ValueError(f"{key} of <{element.tag}> must be three numbers, got {text!r}") from None
    return (x, y, z)


# The compiled code allocates nothing within its loops: a solution takes ten iterations.


@compiled
def _apply(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """Write ``m @ v``."""
    for i in range(3):
        out[i] = m[i, 0] * v[0] + m[i, 1] * v[1] + m[i, 2] * v[2]


@compiled
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write ``a @ b``, which is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@compiled
def _axis_rotation(axis: FloatArray, angle: float, out: FloatArray) -> None:
    """Write the rotation by an angle (rad) about a unit axis."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    t = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = t * x * x + c, t * x * y - s * z, t * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = t * x * y + s * z, t * y * y + c, t * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = t * x * z - s * y, t * y * z + s * x, t * z * z + c


@compiled
def _advance(
    rotation: FloatArray,
    position: FloatArray,
    fixed: FloatArray,
    offset: FloatArray,
    axis: FloatArray,
    angle: float,
    spare: FloatArray,
) -> None:
    """Go from one joint's frame to the next one's, in place.

    :param fixed: rotation (3, 3) before the joint
    :param offset: offset (m) before it
    :param spare: room for two rotations, (2, 3, 3)
    """
    _apply(rotation, offset, spare[0, 0])
    position += spare[0, 0]
    _product(rotation, fixed, spare[0])
    _axis_rotation(axis, angle, spare[1])
    _product(spare[0], spare[1], rotation)


@compiled
def _forward(
    rotations: FloatArray, translations: FloatArray, axes: FloatArray, joints: FloatArray
) -> tuple[FloatArray, FloatArray]:
    rotation, position, spare = np.eye(3), np.zeros(3), np.empty((2, 3, 3))
    for j in range(len(joints)):
        _advance(rotation, position, rotations[j], translations[j], axes[j], joints[j], spare)
    _apply(rotation, translations[-1], spare[0, 0])
    _product(rotation, rotations[-1], spare[1])
    return spare[1].copy(), position + spare[0, 0]


@compiled
def _jacobian(
    rotations: FloatArray,
    translations: FloatArray,
    axes: FloatArray,
    joints: FloatArray,
    tool: FloatArray,
    position: FloatArray,
    jacobian: FloatArray,
    spare: FloatArray,
) -> None:
    """Write the tool's rotation and position, and the (6, n) Jacobian of position and turning (world)."""
    rotation, origins = spare[2], spare[3:]
    rotation[:] = 0.0
    position[:] = 0.0
    for i in range(3):
        rotation[i, i] = 1.0
    for j in range(len(joints)):
        _advance(rotation, position, rotations[j], translations[j], axes[j], joints[j], spare)
        origins[j, 0] = position
        _apply(rotation, axes[j], origins[j, 1])
    _apply(rotation, translations[-1], spare[0, 0])
    position += spare[0, 0]
    _product(rotation, rotations[-1], tool)
    for j in range(len(joints)):
        axis = origins[j, 1]
        x, y, z = (
            position[0] - origins[j, 0, 0],
            position[1] - origins[j, 0, 1],
            position[2] - origins[j, 0, 2],
        )
        jacobian[0, j] = axis[1] * z - axis[2] * y
        jacobian[1, j] = axis[2] * x - axis[0] * z
        jacobian[2, j] = axis[0] * y - axis[1] * x
        jacobian[3:, j] = axis


@compiled
def _rotation_vector(goal: FloatArray, now: FloatArray, out: FloatArray, spare: FloatArray) -> None:
    """Write the rotation vector (rad, world) from ``now`` to ``goal``.

    The antisymmetric part of the rotation matrix vanishes at half a turn. There the symmetric part gives the
    axis.
    """
    _product(goal, now.T, spare)
    r = spare
    out[0], out[1], out[2] = (
        (r[2, 1] - r[1, 2]) / 2.0,
        (r[0, 2] - r[2, 0]) / 2.0,
        (r[1, 0] - r[0, 1]) / 2.0,
    )
    sine, cosine = math.sqrt(_dot(out, out)), (r[0, 0] + r[1, 1] + r[2, 2] - 1.0) / 2.0
    angle = math.atan2(sine, cosine)
    if sine > HALF_TURN_SINE:
        out *= angle / sine
    elif cosine < 0.0:
        column = 0
        for i in range(1, 3):
            if r[i, i] > r[column, column]:
                column = i
        norm = math.sqrt(2.0 * (r[column, column] + 1.0))
        for i in range(3):
            out[i] = (r[i, column] + (1.0 if i == column else 0.0)) * angle / norm


@compiled
def _dot(a: FloatArray, b: FloatArray) -> float:
    """Return the sum of products, the first one first."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _solve(a: FloatArray, x: FloatArray, low: FloatArray) -> None:
    """Solve a symmetric positive definite system by Cholesky decomposition; ``x`` begins as its right side.

    :param low: room for the decomposition
    """
    n = len(x)
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j] - _dot(low[i, :j], low[j, :j])
            low[i, j] = math.sqrt(s) if i == j else s / low[j, j]
    for i in range(n):
        x[i] = (x[i] - _dot(low[i, :i], x[:i])) / low[i, i]
    for i in range(n - 1, -1, -1):
        x[i] = (x[i] - _dot(low[i + 1 :, i], x[i + 1 :])) / low[i, i]


@compiled
def _normal_matrix(jacobian: FloatArray, square: FloatArray) -> None:
    """Write the lower triangle of the damped product (6, 6) of a Jacobian (6, n) and its transpose."""
    for i in range(6):
        for j in range(i + 1):
            square[i, j] = _dot(jacobian[i], jacobian[j])
        square[i, i] += DAMPING


@compiled
def _add_product(jacobian: FloatArray, weights: FloatArray, factor: float, out: FloatArray) -> None:
    """Add ``factor * jacobian.T @ weights``, (n,)."""
    for i in range(6):
        for j in range(len(out)):
            out[j] += factor * jacobian[i, j] * weights[i]


@compiled
def _beyond(joints: FloatArray, limits: FloatArray, out: FloatArray) -> float:
    """Write the change (n,) rad that brings each joint to its limits and return the largest."""
    largest = 0.0
    for j in range(len(joints)):
        out[j] = min(max(joints[j], limits[j, 0]), limits[j, 1]) - joints[j]
        largest = max(largest, abs(out[j]))
    return largest


@compiled
def _null_step(
    jacobian: FloatArray, square: FloatArray, beyond: FloatArray, weights: FloatArray, low: FloatArray
) -> FloatArray:
    """Return the step (n,) in the null space that brings joints nearest to their limits.

    :param beyond: change (n,) rad that brings each joint to its limits, 0 for a joint inside
    :param weights: memory for 6 numbers
    :param low: memory for the decomposition of ``square``
    """
    for i in range(6):
        weights[i] = _dot(jacobian[i], beyond)
    _solve(square, weights, low)
    step = beyond.copy()
    _add_product(jacobian, weights, -1.0, step)
    wanted = norm = largest = 0.0
    for j in range(len(step)):
        largest = max(largest, abs(step[j]))
        if beyond[j] != 0.0:
            wanted += beyond[j] * step[j]
            norm += step[j] * step[j]
    if norm < 1e-12:
        return np.zeros(len(step))
    return step * min(wanted / norm, MAX_NULL_STEP / largest)


@compiled
def _unwind(joints: FloatArray, limits: FloatArray) -> None:
    """Add whole turns to joints beyond their limits where that brings them inside."""
    for j in range(len(joints)):
        turns = 0.0
        if joints[j] > limits[j, 1]:
            turns = -math.ceil((joints[j] - limits[j, 1]) / (2.0 * math.pi))
        elif joints[j] < limits[j, 0]:
            turns = math.ceil((limits[j, 0] - joints[j]) / (2.0 * math.pi))
        turned = joints[j] + 2.0 * math.pi * turns
        if limits[j, 0] <= turned <= limits[j, 1]:
            joints[j] = turned


@compiled
def _inverse(
    rotations: FloatArray,
    translations: FloatArray,
    axes: FloatArray,
    limits: FloatArray,
    goal_rotation: FloatArray,
    goal_position: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, float]:
    n = len(start)
    joints, change, error, weights = start.copy(), np.empty(n), np.empty(6), np.empty(6)
    position, rotation, jacobian, beyond = np.empty(3), np.empty((3, 3)), np.empty((6, n)), np.empty(n)
    square, low, spare = np.empty((6, 6)), np.zeros((6, 6)), np.empty((n + 3, 3, 3))
    for iteration in range(MAX_ITERATIONS + 1):
        _jacobian(rotations, translations, axes, joints, rotation, position, jacobian, spare)
        error[:3] = goal_position - position
        _rotation_vector(goal_rotation, rotation, error[3:], spare[0])
        if _dot(error, error) < TOLERANCE**2:
            _unwind(joints, limits)
        outside = _beyond(joints, limits, beyond)
        is_solved = _dot(error, error) < TOLERANCE**2 and (outside < TOLERANCE or n <= 6)
        if is_solved or iteration == MAX_ITERATIONS:
            break
        _normal_matrix(jacobian, square)
        weights[:] = error
        _solve(square, weights, low)
        change[:] = 0.0
        _add_product(jacobian, weights, 1.0, change)
        if outside > 0.0 and n > 6:
            change += _null_step(jacobian, square, beyond, weights, low)
        share = min(1.0, MAX_JOINT_STEP / max(np.abs(change).max(), 1e-12))
        for j in range(n):
            joints[j] += change[j] * share
    return joints, max(np.abs(error).max(), outside)
