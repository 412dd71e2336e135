"""Motions of motor-driven joints: a trajectory once computed, then a loop that only steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from operator import itemgetter
from typing import Any

import numpy as np

from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.geometry.compilation import compiled
from bulletarm_gym.simulation.state import Body
from bulletarm_gym.simulation.world import World

RISE = 0.5
"""Share of a motion spent speeding up; braking takes the rest. Half and half takes the least torque."""
CAREFUL_RISE = 0.25
"""The same where something may be pushed: slow braking keeps it at the gripper by friction."""
MAX_LAG = 0.03
"""A joint (rad) this far behind its trajectory is blocked: a centimetre or two at the fingertips."""
LAG_CHECK = 4
"""Simulation steps between two looks at the lag."""
MAX_PRESS = 100.0
"""An arm that presses this hard (N) and still goes deeper is blocked: pushing blocks takes 60 N at most."""
MAX_DEPTH = 2e-3
"""Also one that is this deep (m) in something: Bullet's solver gives way before it comes to that force."""
MAX_SQUEEZE = 0.01
"""What is held and is pressed this deep (m) into a finger blocks, too: it stands on something."""
RESTING_PRESS = 20.0
"""A blocked arm goes back the way it came until it presses less than this (N) ..."""
CALM_STEPS = 10
"""... for so many simulation steps: what it pressed into the ground comes up again."""
GIVE_WAY_LIMIT = 60
"""Most simulation steps it goes back."""
STALL_PROGRESS = 1e-4
"""A finger that comes less than this (m) closer to its goal in one step (24 mm/s) is stopped by something."""
FINGER_TOLERANCE = 2e-4
"""Distance (m) at which a finger has arrived."""
FINGER_LIMIT = 60
"""Most simulation steps a gripper motion takes."""
FINGER_START = 2
"""Simulation steps a finger is given to get going."""
SETTLING_STEPS = 3
"""Simulation steps a stopped finger is given to press."""


@dataclass(frozen=True)
class JointGroup:
    """Joints of a body that move together.

    :param slots: their places among the body's movable joints
    :param forces: maximum force (N) or torque (N m) of each
    """

    body: Body
    slots: tuple[int, ...]
    forces: tuple[float, ...]

    @cached_property
    def joints(self) -> list[int]:
        """Their indices in Bullet."""
        return [self.body.joints[slot] for slot in self.slots]

    @cached_property
    def strength(self) -> dict[str, Sequence[float]]:
        """What Bullet takes to drive them to a target: forces and gains, one a joint."""
        gains: Sequence[float] = [1.0] * len(self.slots)
        return {"forces": self.forces, "positionGains": gains, "velocityGains": gains}

    def positions(self, world: World) -> tuple[float, ...]:
        """Return their positions in the world's state."""
        positions: tuple[float, ...] = self._among(world.joints[self.body.index])
        return positions

    @cached_property
    def _among(self) -> "itemgetter[Any]":
        return itemgetter(*self.slots)

    def moved(self, world: World, positions: Sequence[float]) -> list[float]:
        """Return all joint positions of the body with these joints elsewhere."""
        joints = list(world.joints[self.body.index])
        for slot, position in zip(self.slots, positions, strict=True):
            joints[slot] = position
        return joints


@lru_cache(maxsize=256)
def ramp(steps: int, rise: float = RISE) -> FloatArray:
    """Return the share of the way done after each step, ``rise`` of them at a constant acceleration."""
    time = np.arange(1, steps + 1) / steps
    rising = time**2 / rise
    falling = 1.0 - (1.0 - time) ** 2 / (1.0 - rise)
    return np.where(time < rise, rising, falling)


def hold(world: World, group: JointGroup, positions: Sequence[float]) -> None:
    """Send motor targets that keep joints where they should be."""
    world.client.setJointMotorControlArray(
        group.body.id,
        group.joints,
        world.client.POSITION_CONTROL,
        targetPositions=positions,
        **group.strength,
    )


def on_the_way(stops: Sequence[Sequence[float]], shares: FloatArray) -> FloatArray:
    """Return where joints are on a way through evenly spaced stops, (n, joints), after shares (n,) of it."""
    return _interpolate(np.array(stops, dtype=np.float64), np.asarray(shares, dtype=np.float64))


@compiled
def _interpolate(stops: FloatArray, shares: FloatArray) -> FloatArray:
    """Return what ``np.interp`` would for each joint, the stops evenly spaced from 0 to 1."""
    pieces = len(stops) - 1
    width = 1.0 / pieces
    way = np.empty((len(shares), stops.shape[1]))
    for row in range(len(shares)):
        piece = min(int(shares[row] * pieces), pieces - 1)
        if shares[row] < piece * width:
            piece -= 1
        elif piece + 1 < pieces and shares[row] >= (piece + 1) * width:
            piece += 1
        start = piece * width
        end = 1.0 if piece + 1 == pieces else (piece + 1) * width
        for joint in range(stops.shape[1]):
            first, last = stops[piece, joint], stops[piece + 1, joint]
            slope = (last - first) / (end - start)
            way[row, joint] = last if shares[row] >= 1.0 else slope * (shares[row] - start) + first
    return way


def follow(
    world: World,
    group: JointGroup,
    stops: Sequence[Sequence[float]],
    steps: int,
    held: Body | None,
    rise: float = RISE,
) -> None:
    """Drive joints through stops to the last in a number of simulation steps; a blocked arm stops there.

    :param held: a body in the gripper, which does not block it
    :param rise: share of the motion spent speeding up
    """
    start = group.positions(world)
    path = [start, *on_the_way([start, *stops], ramp(steps, rise)).tolist()]
    depth = math.inf
    for number in range(1, steps + 1):
        hold(world, group, path[number])
        world.client.stepSimulation()
        before, (force, depth) = depth, press(world, group.body, held)
        if depth > before and (force > MAX_PRESS or depth > MAX_DEPTH):
            _give_way(world, group, path[:number], held)
            return
        if number % LAG_CHECK == 0 and _lag(world, group, path[number]) > MAX_LAG:
            _stop(world, group)
            return


def press(world: World, body: Body, held: Body | None) -> tuple[float, float]:
    """Return how hard (N) and how deep (m) a body presses on others than what it holds gently."""
    points = world.client.getContactPoints(body.id)
    if held is not None:
        points = [point for point in points if point[2] != held.id or -point[8] > MAX_SQUEEZE]
    if not points:
        return 0.0, 0.0
    return sum([point[9] for point in points]), -min([point[8] for point in points])


def _give_way(world: World, group: JointGroup, path: Sequence[Sequence[float]], held: Body | None) -> None:
    """Go back on a path until nothing presses hard any more, and stop there."""
    back, calm = len(path) - 1, 0
    for _ in range(GIVE_WAY_LIMIT):
        hold(world, group, path[back])
        world.client.stepSimulation()
        force, depth = press(world, group.body, held)
        calm = calm + 1 if force < RESTING_PRESS and depth < MAX_DEPTH / 2.0 else 0
        if calm == CALM_STEPS:
            break
        back = max(back - (calm == 0), 0)
    _stop(world, group)


def _stop(world: World, group: JointGroup) -> None:
    hold(world, group, [state[0] for state in world.client.getJointStates(group.body.id, group.joints)])
    world.client.stepSimulation()


def _lag(world: World, group: JointGroup, target: Sequence[float]) -> float:
    states = world.client.getJointStates(group.body.id, group.joints)
    return float(max(abs(state[0] - goal) for state, goal in zip(states, target, strict=True)))


def send_fingers(world: World, group: JointGroup, goal: float, speed: float) -> None:
    """Send the fingers' motor target: to close on what is between them, or to open."""
    for joint, force in zip(group.joints, group.forces, strict=True):
        world.client.setJointMotorControl2(
            group.body.id,
            joint,
            world.client.POSITION_CONTROL,
            targetPosition=goal,
            force=force,
            positionGain=1.0,
            velocityGain=1.0,
            maxVelocity=speed,
        )


def drive_fingers(world: World, group: JointGroup, goal: float, speed: float) -> None:
    """Step until the fingers arrive or what is between them stops them."""
    send_fingers(world, group, goal, speed)
    left = math.inf
    for number in range(FINGER_LIMIT):
        world.client.stepSimulation()
        states = world.client.getJointStates(group.body.id, group.joints)
        before, left = left, max(abs(state[0] - goal) for state in states)
        if left < FINGER_TOLERANCE or (number >= FINGER_START and before - left < STALL_PROGRESS):
            break
    world.step(SETTLING_STEPS)


def motion_steps(distance: float, reference_distance: float, reference_steps: int, least: int) -> int:
    """Return how many simulation steps a motion takes at the acceleration of a reference motion."""
    return max(least, math.ceil(reference_steps * math.sqrt(distance / reference_distance)))
