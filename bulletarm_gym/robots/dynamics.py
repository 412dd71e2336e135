"""Inverse dynamics of a serial arm, and the duration of a motion within the torques of its joints."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from bulletarm_gym.geometry import FloatArray, matrix
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.robots.kinematics import Chain, Frames, advance, apply, dot, product
from bulletarm_gym.simulation import Body
from bulletarm_gym.simulation.motion import RISE
from bulletarm_gym.simulation.world import GRAVITY, TIME_STEP

Model = tuple[Frames, FloatArray, FloatArray, FloatArray, float]
"""Frames of a chain; masses, centres and inertias of its links; mass at the tool."""

TORQUE_SHARE = 0.9
"""Fraction of the maximum torque for motions in free space. The rest is for contacts."""
MIN_ACCELERATION_SHARE = 0.1
"""Minimum fraction of the torque for acceleration, even if gravity takes more than the rest."""
MAX_STEPS = 480
"""Maximum number of simulation steps of a motion (2 s)."""


@dataclass(frozen=True)
class Dynamics:
    """Masses and inertias of the links of a chain.

    :param chain: kinematics
    :param masses: (n,) kg
    :param centres: (n, 3) centre of mass (m) of each link in the frame of its joint
    :param inertias: (n, 3, 3) inertia (kg m^2) about the centre of mass, along the axes of this frame
    :param tip_mass: mass (kg) of the fingers, a point at the tool
    """

    chain: Chain
    masses: FloatArray
    centres: FloatArray
    inertias: FloatArray
    tip_mass: float

    @classmethod
    def of(cls, arm: Body, joints: list[int], chain: Chain) -> "Dynamics":
        """Return the dynamics of a loaded arm.

        :param joints: indices of the chain's joints in Bullet
        """
        moved = [arm.links[joint] for joint in joints]
        axes = [matrix(link.frame) for link in moved]
        inertias = [axis @ np.diag(link.inertia) @ axis.T for axis, link in zip(axes, moved, strict=True)]
        tip = {joints[-1]}
        for index, link in enumerate(arm.links):  # a link comes after its parent
            if link.parent in tip:
                tip.add(index)
        tip_mass = sum(arm.links[index].mass for index in sorted(tip - {joints[-1]}))
        masses, centres = np.array([link.mass for link in moved]), [link.frame.position for link in moved]
        return cls(chain, masses, np.array(centres), np.array(inertias), tip_mass)

    def torques(
        self, positions: FloatArray, rates: FloatArray, accelerations: FloatArray, load: float = 0.0
    ) -> FloatArray:
        """Return the joint torques (n,) N m of a motion under gravity.

        :param positions: joint positions (n,) rad
        :param rates: joint velocities (n,) rad/s
        :param accelerations: joint accelerations (n,) rad/s^2
        :param load: mass (kg) of the grasped object, a point at the tool
        """
        return _torques(self._model(load), positions, rates, accelerations)

    def least_steps(self, path: FloatArray, limits: FloatArray, load: float, rise: float = RISE) -> int:
        """Return the minimum number of simulation steps of a motion along a path.

        The torque is the static torque plus a part inversely proportional to the square of the duration. Both
        are computed at the phases with the largest torques, see :func:`phases`.

        :param path: (k, n) joint positions (rad) at equal distances along the path
        :param limits: (n,) maximum torques (N m)
        :param load: mass (kg) of the grasped object
        :param rise: fraction of the motion with positive acceleration
        """
        seconds = math.sqrt(_least_square(self._model(load), path, TORQUE_SHARE * limits, phases(rise)))
        return min(math.ceil(seconds / TIME_STEP), MAX_STEPS)

    def _model(self, load: float) -> Model:
        return (self.chain.frames, self.masses, self.centres, self.inertias, self.tip_mass + load)


@cache
def phases(rise: float) -> FloatArray:
    """Return share, speed and acceleration of a motion of one second at the start, maximum speed and end."""
    rising, braking = 2.0 / rise, -2.0 / (1.0 - rise)
    return np.array(((0.0, 0.0, rising), (rise, 2.0, rising), (rise, 2.0, braking), (1.0, 0.0, braking)))


@compiled
def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@compiled
def _torques(model: Model, positions: FloatArray, rates: FloatArray, accelerations: FloatArray) -> FloatArray:
    """Return the torques (n,) N m by the recursive Newton-Euler algorithm, in world coordinates."""
    frames, masses, centres, inertias, tip_mass = model
    _, translations, axes = frames
    n = len(positions)
    rotation, origin, spare = np.eye(3), np.zeros(3), np.empty((2, 3, 3))
    omega, alpha, linear = np.zeros(3), np.zeros(3), np.array((0.0, 0.0, -GRAVITY))
    origins, directions, torques = np.empty((n, 3)), np.empty((n, 3)), np.zeros(n)
    direction, arm = np.empty(3), np.empty(3)
    for j in range(n + 1):
        before = origin.copy()
        if j < n:
            advance(rotation, origin, frames, j, positions[j], spare)
        else:
            apply(rotation, translations[n], arm)
            origin += arm
        offset = origin - before
        linear = linear + _cross(alpha, offset) + _cross(omega, _cross(omega, offset))
        if j == n:
            force, moment, point = tip_mass * linear, np.zeros(3), origin
        else:
            apply(rotation, axes[j], direction)
            alpha = alpha + direction * accelerations[j] + _cross(omega, direction * rates[j])
            omega = omega + direction * rates[j]
            origins[j], directions[j] = origin, direction
            apply(rotation, centres[j], arm)
            point = origin + arm
            force = masses[j] * (linear + _cross(alpha, arm) + _cross(omega, _cross(omega, arm)))
            product(rotation, inertias[j], spare[0])
            product(spare[0], rotation.T, spare[1])
            spin = np.empty(3)
            apply(spare[1], omega, spin)
            moment = _cross(omega, spin)
            apply(spare[1], alpha, spin)
            moment = moment + spin
        for k in range(min(j + 1, n)):
            lever = moment + _cross(point - origins[k], force)
            torques[k] += dot(directions[k], lever)
    return torques


@compiled
def _least_square(model: Model, path: FloatArray, limits: FloatArray, phases: FloatArray) -> float:
    """Return the square of the shortest duration (s) of a motion along a path."""
    pieces, n = len(path) - 1, path.shape[1]
    still, square = np.zeros(n), 0.0
    for phase in range(len(phases)):
        share, rate, acceleration = phases[phase]
        piece = min(int(share * pieces), pieces - 1)
        slope = (path[piece + 1] - path[piece]) * pieces
        here = path[piece] + slope * (share - piece / pieces)
        static = _torques(model, here, still, still)
        total = _torques(model, here, slope * rate, slope * acceleration)
        for j in range(n):
            room = max(limits[j] - abs(static[j]), MIN_ACCELERATION_SHARE * limits[j])
            square = max(square, abs(total[j] - static[j]) / room)
    return square
