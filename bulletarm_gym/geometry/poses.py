"""Rigid poses, rectangles and rotations.

Metres, radians, right-handed world frame with z up, quaternions ``(x, y, z, w)`` as in Bullet. The functions
process single poses in plain arithmetic, which is faster than NumPy on three numbers.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config_checks import numbers, rule

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int32]
Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
UNIT_TOLERANCE = 1e-3
"""Maximum error of the length of a unit quaternion."""


class Pose(NamedTuple):
    """Position (m) and orientation of a frame in another frame, by default in the world."""

    position: Vector
    orientation: Quaternion = IDENTITY

    @classmethod
    def planar(cls, x: float, y: float, z: float, yaw: float = 0.0) -> "Pose":
        """Return an upright pose, rotated by ``yaw`` (rad) about z."""
        return cls((x, y, z), yaw_quaternion(yaw))

    @property
    def x(self) -> float:
        """First coordinate (m)."""
        return self.position[0]

    @property
    def y(self) -> float:
        """Second coordinate (m)."""
        return self.position[1]

    @property
    def z(self) -> float:
        """Third coordinate (m)."""
        return self.position[2]

    @property
    def yaw(self) -> float:
        """Rotation about z (rad, in (-pi, pi]), the last of the fixed-axis x-y-z angles."""
        x, y, z, w = self.orientation
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def tilt(self) -> float:
        """Angle between the frame's z axis and the world's (rad, in [0, pi])."""
        x, y, _, _ = self.orientation
        return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))

    def transform(self, point: Vector) -> Vector:
        """Return the coordinates (m) in the outer frame of a point in this frame."""
        px, py, pz = rotate(self.orientation, point)
        return (px + self.position[0], py + self.position[1], pz + self.position[2])

    def compose(self, inner: "Pose") -> "Pose":
        """Return the pose in the outer frame of a pose in this frame."""
        return Pose(self.transform(inner.position), multiply(self.orientation, inner.orientation))

    def inverse(self) -> "Pose":
        """Return the pose of the outer frame in this frame."""
        back = conjugate(self.orientation)
        x, y, z = rotate(back, self.position)
        return Pose((-x, -y, -z), back)


def _plain_pose(value: Any) -> Pose:
    if not isinstance(value, Pose):
        raise TypeError
    return Pose(numbers(count=3)(value.position), numbers(count=4)(value.orientation))


pose_check = rule(
    "a Pose of a position (x, y, z) and a unit quaternion (x, y, z, w)",
    lambda pose: abs(math.hypot(*pose.orientation) - 1.0) < UNIT_TOLERANCE,
    _plain_pose,
)
"""Check of poses that users pass."""


class Rectangle(NamedTuple):
    """A horizontal rectangle in the world.

    :param x: x coordinate of the centre (m)
    :param y: y coordinate of the centre (m)
    :param length: side along the rectangle's x axis (m)
    :param width: side along the rectangle's y axis (m)
    :param yaw: rotation of the rectangle's axes about z (rad)
    """

    x: float
    y: float
    length: float
    width: float
    yaw: float


def yaw_quaternion(yaw: float) -> Quaternion:
    """Return the quaternion of a rotation by ``yaw`` (rad) about z."""
    return (0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))


def euler_pose(position: Vector, angles: Vector) -> Pose:
    """Return a pose from fixed-axis x-y-z angles (rad): roll, pitch and yaw in URDF and Bullet."""
    (sr, cr), (sp, cp), _ = ((math.sin(angle / 2.0), math.cos(angle / 2.0)) for angle in angles)
    tilt = multiply((0.0, sp, 0.0, cp), (sr, 0.0, 0.0, cr))
    return Pose(position, multiply(yaw_quaternion(angles[2]), tilt))


def euler_angles(q: Quaternion) -> Vector:
    """Return the fixed-axis x-y-z angles (rad) of a rotation, as in :func:`euler_pose` and URDF.

    The pitch is in [-pi/2, pi/2]. At both ends only a sum of the other angles is defined. There the yaw is 0.
    """
    x, y, z, w = q
    sine = max(-1.0, min(1.0, 2.0 * (w * y - z * x)))
    if abs(sine) > 1.0 - 1e-12:
        return (2.0 * math.atan2(x, w), math.copysign(math.pi / 2.0, sine), 0.0)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return (roll, math.asin(sine), math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    return (-q[0], -q[1], -q[2], q[3])


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation that applies ``b`` first, then ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def scaled(vector: Vector, factor: float) -> Vector:
    """Return the product of a vector and a number."""
    x, y, z = vector
    return (x * factor, y * factor, z * factor)


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Rotate a vector by a unit quaternion."""
    qx, qy, qz, qw = q
    vx, vy, vz = v
    tx, ty, tz = 2.0 * (qy * vz - qz * vy), 2.0 * (qz * vx - qx * vz), 2.0 * (qx * vy - qy * vx)
    return (
        vx + qw * tx + qy * tz - qz * ty,
        vy + qw * ty + qz * tx - qx * tz,
        vz + qw * tz + qx * ty - qy * tx,
    )


def interpolate(start: Pose, end: Pose, share: float) -> Pose:
    """Return the pose at a share (0 to 1) of the path between two poses, along the shorter rotation."""
    if share >= 1.0:
        return end
    pairs = list(zip(start.orientation, end.orientation, strict=True))
    near = math.copysign(1.0, sum(a * b for a, b in pairs))
    x, y, z = ((1.0 - share) * a + share * b for a, b in zip(start.position, end.position, strict=True))
    mixed = [(1.0 - share) * a + share * near * b for a, b in pairs]
    norm = math.hypot(*mixed)
    qx, qy, qz, qw = (part / norm for part in mixed)
    return Pose((x, y, z), (qx, qy, qz, qw))


def matrix(pose: Pose) -> FloatArray:
    """Return the (3, 3) rotation matrix of a pose."""
    x, y, z, w = pose.orientation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(rotation: FloatArray) -> Quaternion:
    """Return the quaternion of a (3, 3) rotation matrix."""
    m = rotation.tolist()
    candidates = (
        (1 + m[0][0] - m[1][1] - m[2][2], m[1][0] + m[0][1], m[2][0] + m[0][2], m[2][1] - m[1][2]),
        (m[1][0] + m[0][1], 1 - m[0][0] + m[1][1] - m[2][2], m[2][1] + m[1][2], m[0][2] - m[2][0]),
        (m[2][0] + m[0][2], m[2][1] + m[1][2], 1 - m[0][0] - m[1][1] + m[2][2], m[1][0] - m[0][1]),
        (m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1 + m[0][0] + m[1][1] + m[2][2]),
    )
    best = max(range(4), key=lambda i: candidates[i][i])
    norm = math.hypot(*candidates[best])
    x, y, z, w = (value / norm for value in candidates[best])
    return (x, y, z, w)


def wrap_angle(angle: float, period: float = 2.0 * math.pi) -> float:
    """Return the angle (rad) in [-period/2, period/2) that equals ``angle`` modulo ``period``."""
    wrapped = (angle + period / 2.0) % period - period / 2.0
    return wrapped if wrapped < period / 2.0 else -period / 2.0  # Python rounds -1e-17 % period to period


def planar_distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the horizontal distance (m) between two points."""
    return math.hypot(a[0] - b[0], a[1] - b[1])
