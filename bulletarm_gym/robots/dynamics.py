"""Inverse dynamics of a serial arm, and the duration of a motion within the torques of its joints."""

import math

import numpy as np

from bulletarm_gym.geometry import FloatArray, matrix
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.robots.kinematics import Chain, Frames, advance, apply, dot, product
from bulletarm_gym.simulation import Body
from bulletarm_gym.simulation.motion import RISE
from bulletarm_gym.simulation.world import GRAVITY, TIME_STEP

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

    def __init__(self, arm: Body, joints: list[int], chain: Chain) -> None:
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
        self._frames = (chain.rotations, chain.translations, np.vstack([chain.axes, (0.0, 0.0, 1.0)]))

    def torques(
        self, positions: FloatArray, rates: FloatArray, accelerations: FloatArray, load: float = 0.0
    ) -> FloatArray:
        """Return the joint torques (n,) N m of a motion under gravity.

        :param positions: joint positions (n,) rad
        :param rates: joint velocities (n,) rad/s
        :param accelerations: joint accelerations (n,) rad/s^2
        :param load: mass (kg) of the grasped object
        """
        motion = [np.append(values, 0.0) for values in (positions, rates, accelerations)]
        torques: FloatArray = _torques(self._model(load), *motion)[:-1]
        return torques

    def least_steps(self, path: FloatArray, limits: FloatArray, load: float, rise: float = RISE) -> int:
        """Return the minimum number of simulation steps of a motion along a path.

        The torque is the static torque plus a part inversely proportional to the square of the duration. Both
        are computed at the start, at the maximum speed and at the end, where torques are largest.

        :param path: (k, n) joint positions (rad) at equal distances along the path
        :param limits: (n,) maximum torques (N m)
        :param load: mass (kg) of the grasped object
        :param rise: fraction of the motion with positive acceleration
        """
        rising, braking = 2.0 / rise, -2.0 / (1.0 - rise)  # of a motion of length 1 in one second
        phases = ((0.0, 0.0, rising), (rise, 2.0, rising), (rise, 2.0, braking), (1.0, 0.0, braking))
        path = np.pad(path, ((0, 0), (0, 1)))
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
    """Return the square of the shortest duration (s) of a motion along a path.

    :param phases: (k, 3) share of the path, speed and acceleration of a motion of one second
    """
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
