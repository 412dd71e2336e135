"""Motions of motor-driven joints: a trajectory computed in advance, then a loop of simulation steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter

import numpy as np

from bulletarm_gym.geometry import FloatArray, Vector
from bulletarm_gym.simulation.loading import set_resistance
from bulletarm_gym.simulation.state import Body
from bulletarm_gym.simulation.world import World

OTHER, NORMAL, DISTANCE, FORCE = 2, 7, 8, 9
"""Indices in Bullet's contact points: the other body, the normal, the gap (m) and the normal force (N)."""
RISE = 0.5
"""Fraction of a motion with positive acceleration. One half needs the smallest torque."""
CONTACT_RISE = 0.25
"""The fraction for motions in contact, so that friction keeps pushed objects at the braking gripper."""
MAX_LAG = 0.03
"""Maximum distance (rad) of a joint from its trajectory: one or two centimetres at the fingertips."""
LAG_CHECK = 4
"""Number of simulation steps between two checks of this distance."""
MAX_FORCE = 100.0
"""Contact force (N) above which an arm that penetrates further is blocked. Pushing takes at most 60 N."""
MAX_DEPTH = 2e-3
"""Depth (m) above which an arm that penetrates further is blocked, independent of the force."""
MAX_SQUEEZE = 0.01
"""Depth (m) of the grasped object in a finger above which it blocks the arm: a body supports it."""
RETREAT_FORCE = 20.0
"""Contact force (N) below which the retreat of a blocked arm ends, so that pressed objects recover."""
CALM_STEPS = 10
"""Number of consecutive simulation steps below this force that end the retreat."""
RETREAT_LIMIT = 60
"""Maximum number of simulation steps of a retreat."""
STALL_PROGRESS = 1e-4
"""Progress (m) of a finger in one simulation step below which something stops it (24 mm/s)."""
FINGER_TOLERANCE = 2e-4
"""Distance (m) from the goal at which a finger has arrived."""
FINGER_LIMIT = 60
"""Maximum number of simulation steps of a gripper motion."""
GEAR_FORCE = 200.0
"""Maximum force (N) that keeps the positions of the fingers equal, well above the gripper's force."""
SPINNING_FRICTION = 0.1
"""Friction coefficient of the pads against rotation about the contact normal (the Panda in pybullet_data)."""


@dataclass(frozen=True)
class JointGroup:
    """Joints of a body that move together.

    :param joints: their indices, in the body and in Bullet
    :param forces: maximum force (N) or torque (N m) of each joint
    """

    body: Body
    joints: tuple[int, ...]
    forces: tuple[float, ...]

    def positions(self, world: World) -> tuple[float, ...]:
        """Return the joint positions in the state of the world."""
        positions = world.joints[self.body.index]
        return tuple([positions[joint] for joint in self.joints])

    def moved(self, world: World, positions: Sequence[float]) -> list[float]:
        """Return the positions of all joints of the body, with other positions of these joints."""
        all_positions = list(world.joints[self.body.index])
        for joint, position in zip(self.joints, positions, strict=True):
            all_positions[joint] = position
        return all_positions


def add_gear_constraint(world: World, fingers: JointGroup, friction: float) -> None:
    """Keep the positions of two fingers equal, and set the friction of their pads.

    Friction anchors restore the contact points on curved paths. Spinning friction stops an object from
    rotating about the line between the pads.

    :param friction: lateral friction coefficient of the pads
    """
    client, body, (left, right) = world.client, fingers.body.id, fingers.joints
    for joint in (left, right):
        client.changeDynamics(
            body, joint, lateralFriction=friction, spinningFriction=SPINNING_FRICTION, frictionAnchor=1
        )
    ends, origin = (body, left, body, right), (0, 0, 0)
    gear = client.createConstraint(*ends, client.JOINT_GEAR, (1, 0, 0), origin, origin)
    client.changeConstraint(gear, gearRatio=-1, erp=0.2, maxForce=GEAR_FORCE)


@lru_cache(maxsize=256)
def velocity_profile(steps: int, rise: float = RISE) -> FloatArray:
    """Return the completed share (steps,) of a path after each step of a triangular velocity profile.

    :param rise: fraction of the steps with positive acceleration
    """
    time = np.arange(1, steps + 1) / steps
    rising = time**2 / rise
    falling = 1.0 - (1.0 - time) ** 2 / (1.0 - rise)
    return np.where(time < rise, rising, falling)


def interpolate_path(stops: Sequence[Sequence[float]], shares: FloatArray) -> FloatArray:
    """Return the joint positions (n, joints) at shares (n,) of a path through evenly spaced stops."""
    ends = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(shares, ends, joint) for joint in zip(*stops, strict=True)], axis=1)


def hold(world: World, group: JointGroup, positions: Sequence[float]) -> None:
    """Set the position targets of motors."""
    gains = [1.0] * len(group.joints)
    world.client.setJointMotorControlArray(
        group.body.id,
        group.joints,
        world.client.POSITION_CONTROL,
        targetPositions=positions,
        forces=group.forces,
        positionGains=gains,
        velocityGains=gains,
    )


def follow(
    world: World,
    group: JointGroup,
    stops: Sequence[Sequence[float]],
    steps: int,
    held: Body | None,
    rise: float = RISE,
) -> Vector | None:
    """Move joints through stops to the last one in a number of simulation steps. A blocked arm stops.

    :param held: the grasped object, which does not block the arm
    :param rise: fraction of the motion with positive acceleration
    :return: unit vector out of the body that blocks the arm, world; None if no contact blocks it
    """
    start = group.positions(world)
    path = [start, *interpolate_path([start, *stops], velocity_profile(steps, rise)).tolist()]
    depth = math.inf
    for number in range(1, steps + 1):
        hold(world, group, path[number])
        world.step()
        before, (force, depth, normal) = depth, contact_load(world, group.body, held)
        if depth > before and (force > MAX_FORCE or depth > MAX_DEPTH):
            _retreat(world, group, path[:number], held)
            return normal
        if number % LAG_CHECK == 0:
            lags = [abs(now - goal) for now, goal in zip(_measure(world, group), path[number], strict=True)]
            if max(lags) > MAX_LAG:
                _stop(world, group)
                return None
    return None


def contact_load(world: World, body: Body, held: Body | None) -> tuple[float, float, Vector | None]:
    """Return the total contact force (N) of a body, its penetration depth (m), and the normal there.

    :param held: the grasped object, which counts only if it is deeper than :data:`MAX_SQUEEZE`
    """
    # Bullet's tuples: this is called in every simulation step, where Contact objects double its time.
    points = world.client.getContactPoints(body.id)
    if held is not None:
        points = [point for point in points if point[OTHER] != held.id or -point[DISTANCE] > MAX_SQUEEZE]
    if not points:
        return 0.0, 0.0, None
    deepest = min(points, key=itemgetter(DISTANCE))
    return sum([point[FORCE] for point in points]), -deepest[DISTANCE], deepest[NORMAL]


def _retreat(world: World, group: JointGroup, path: Sequence[Sequence[float]], held: Body | None) -> None:
    back, calm = len(path) - 1, 0
    for _ in range(RETREAT_LIMIT):
        hold(world, group, path[back])
        world.step()
        force, depth, _ = contact_load(world, group.body, held)
        calm = calm + 1 if force < RETREAT_FORCE and depth < MAX_DEPTH / 2.0 else 0
        if calm == CALM_STEPS:
            break
        back = max(back - (calm == 0), 0)
    _stop(world, group)


def _measure(world: World, group: JointGroup) -> list[float]:
    return [state[0] for state in world.client.getJointStates(group.body.id, group.joints)]


def _stop(world: World, group: JointGroup) -> None:
    hold(world, group, _measure(world, group))
    world.step()


def set_resistance_factor(world: World, factor: float) -> None:
    """Multiply the resistance of the moving parts of all bodies by a factor, until the next call."""
    for body in world.bodies:
        set_resistance(world.client, body.id, body.spec, factor)


def send_fingers(world: World, group: JointGroup, goal: float, speed: float) -> None:
    """Set the position target (m) and the maximum speed (m/s) of the fingers' motors."""
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
    """Move the fingers until they arrive or an object stops them."""
    send_fingers(world, group, goal, speed)
    left = math.inf
    for number in range(FINGER_LIMIT):
        world.step()
        before, left = left, max(abs(position - goal) for position in _measure(world, group))
        has_started = number >= 2
        if left < FINGER_TOLERANCE or (has_started and before - left < STALL_PROGRESS):
            break
    world.step(3)  # a stopped finger builds up its force
