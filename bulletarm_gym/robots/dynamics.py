"""Inverse dynamics of a serial arm: how long a motion takes with the torques of its joints."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose, matrix
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.robots.kinematics import Chain, _advance, _apply, _dot, _product
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.simulation.motion import RISE
from bulletarm_gym.simulation.world import GRAVITY, TIME_STEP

Model = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float]
"""Rotations, translations and axes of a chain; masses, centres and inertias of links; mass at the tool."""

TORQUE_SHARE = 0.9
"""Share of the joints' maximum torque that motions use in free space; the rest is left for contacts."""
MIN_ROOM = 0.1
"""Minimum share of the torque that is left for acceleration where gravity takes nearly all of it."""
MAX_STEPS = 480
"""Maximum number of simulation steps of a motion (2 s)."""


@dataclass(frozen=True)
class Dynamics:
    """Masses of the links that the joints of a chain move.

    :param chain: kinematics
    :param masses: (n,) kg
    :param centres: (n, 3) centre of mass (m) of each link in the frame of its joint
    :param inertias: (n, 3, 3) inertia (kg m^2) about the centre of mass, along the axes of that frame
    :param tip_mass: mass (kg) of the fingers, at the tool
    """

    chain: Chain
    masses: FloatArray
    centres: FloatArray
    inertias: FloatArray
    tip_mass: float

    @classmethod
    def of(cls, world: World, arm: Body, joints: list[int], chain: Chain) -> "Dynamics":
        """Read the masses of a loaded arm.

        :param joints: indices of the chain's joints in Bullet
        """
        client = world.client
        links = range(client.getNumJoints(arm.id))
        parents = {link: client.getJointInfo(arm.id, link)[16] for link in links}
        tips = [link for link in links if _hangs_on(link, joints[-1], parents)]
        tip_mass = sum(client.getDynamicsInfo(arm.id, link)[0] for link in tips)
        masses, centres, inertias = [], [], []
        for joint in joints:
            mass, _, moments, centre, orientation = client.getDynamicsInfo(arm.id, joint)[:5]
            axes = matrix(Pose((0.0, 0.0, 0.0), orientation))
            masses.append(mass)
            centres.append(centre)
            inertias.append(axes @ np.diag(moments) @ axes.T)
        return cls(chain, np.array(masses), np.array(centres), np.array(inertias), tip_mass)

    def torques(
        self, positions: FloatArray, rates: FloatArray, accelerations: FloatArray, load: float = 0.0
    ) -> FloatArray:
        """Return the joint torques (n,) N m of a motion under gravity.

        :param positions: (n,) rad
        :param rates: (n,) rad/s
        :param accelerations: (n,) rad/s^2
        :param load: mass (kg) of the grasped object, a point at the tool
        """
        return _torques(*self._model(load), positions, rates, accelerations)

    def least_steps(self, path: FloatArray, limits: FloatArray, load: float, rise: float = RISE) -> int:
        """Return the least number of simulation steps in which the joints can move along a path.

        The torque of a motion of T seconds is the static one and a part that falls with T squared. Both are
        computed at the phases of the motion where they are largest, see :func:`phases`.

        :param path: (k, n) rad, evenly spaced in time but for the speed profile
        :param limits: (n,) maximum torques (N m)
        :param load: mass (kg) of the grasped object
        :param rise: share of the motion spent speeding up
        """
        seconds = math.sqrt(_least_square(self._model(load), path, TORQUE_SHARE * limits, phases(rise)))
        return min(math.ceil(seconds / TIME_STEP), MAX_STEPS)

    def _model(self, load: float) -> Model:
        chain = self.chain
        links = (self.masses, self.centres, self.inertias)
        return (chain.rotations, chain.translations, chain.axes, *links, self.tip_mass + load)


@cache
def phases(rise: float) -> FloatArray:
    """Return share, speed and acceleration of a motion of one second at its start, full speed and end."""
    rising, braking = 2.0 / rise, -2.0 / (1.0 - rise)
    return np.array(((0.0, 0.0, rising), (rise, 2.0, rising), (rise, 2.0, braking), (1.0, 0.0, braking)))


def _hangs_on(link: int, ancestor: int, parents: dict[int, int]) -> bool:
    while link in parents:
        link = parents[link]
        if link == ancestor:
            return True
    return False


@compiled
def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@compiled
def _torques(
    rotations: FloatArray,
    translations: FloatArray,
    axes: FloatArray,
    masses: FloatArray,
    centres: FloatArray,
    inertias: FloatArray,
    tip_mass: float,
    positions: FloatArray,
    rates: FloatArray,
    accelerations: FloatArray,
) -> FloatArray:
    """Return the torques (n,) N m by the recursive Newton-Euler algorithm, in world coordinates."""
    n = len(positions)
    rotation, origin, spare = np.eye(3), np.zeros(3), np.empty((2, 3, 3))
    omega, alpha, linear = np.zeros(3), np.zeros(3), np.array((0.0, 0.0, -GRAVITY))
    origins, directions, torques = np.empty((n, 3)), np.empty((n, 3)), np.zeros(n)
    direction, arm = np.empty(3), np.empty(3)
    for j in range(n + 1):
        before = origin.copy()
        if j < n:
            _advance(rotation, origin, rotations[j], translations[j], axes[j], positions[j], spare)
        else:
            _apply(rotation, translations[n], arm)
            origin += arm
        offset = origin - before
        linear = linear + _cross(alpha, offset) + _cross(omega, _cross(omega, offset))
        if j == n:
            force, moment, point = tip_mass * linear, np.zeros(3), origin
        else:
            _apply(rotation, axes[j], direction)
            alpha = alpha + direction * accelerations[j] + _cross(omega, direction * rates[j])
            omega = omega + direction * rates[j]
            origins[j], directions[j] = origin, direction
            _apply(rotation, centres[j], arm)
            point = origin + arm
            force = masses[j] * (linear + _cross(alpha, arm) + _cross(omega, _cross(omega, arm)))
            _product(rotation, inertias[j], spare[0])
            _product(spare[0], rotation.T, spare[1])
            spin = np.empty(3)
            _apply(spare[1], omega, spin)
            moment = _cross(omega, spin)
            _apply(spare[1], alpha, spin)
            moment = moment + spin
        for k in range(min(j + 1, n)):
            lever = moment + _cross(point - origins[k], force)
            torques[k] += _dot(directions[k], lever)
    return torques


@compiled
def _least_square(
    model: Model,
    path: FloatArray,
    limits: FloatArray,
    phases: FloatArray,
) -> float:
    """Return the square of the shortest duration (s) of a motion along a path."""
    pieces, n = len(path) - 1, path.shape[1]
    still, square = np.zeros(n), 0.0
    for phase in range(len(phases)):
        share, rate, acceleration = phases[phase]
        piece = min(int(share * pieces), pieces - 1)
        slope = (path[piece + 1] - path[piece]) * pieces
        here = path[piece] + slope * (share - piece / pieces)
        static = _torques(*model, here, still, still)
        total = _torques(*model, here, slope * rate, slope * acceleration)
        for j in range(n):
            room = max(limits[j] - abs(static[j]), MIN_ROOM * limits[j])
            square = max(square, abs(total[j] - static[j]) / room)
    return square
