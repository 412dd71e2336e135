"""Bodies of a world and their state in plain numbers."""

from dataclasses import dataclass

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.simulation.properties import Properties
from bulletarm_gym.simulation.shapes import BodySpec

Twist = tuple[Vector, Vector]
STILL: Twist = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Body:
    """A body of the world, by which all others name it.

    :param index: its place in the world's order and in :class:`WorldState`
    :param joints: indices of its movable joints in Bullet
    """

    index: int
    id: int
    spec: BodySpec
    joints: tuple[int, ...] = ()


@dataclass(frozen=True)
class WorldState:
    """Everything that decides what happens next, in plain numbers.

    :param poses: of every body's frame
    :param twists: linear (m/s) and angular (rad/s) velocity of every body
    :param active: whether a body takes part or is parked
    :param joints: positions (m or rad) of every body's movable joints
    :param joint_rates: their velocities (m/s or rad/s)
    :param unsettled: indices of bodies that were placed or lost their support and have not rested since
    :param properties: index and properties of each body that has others than its specification
    """

    poses: tuple[Pose, ...]
    twists: tuple[Twist, ...]
    active: tuple[bool, ...]
    joints: tuple[tuple[float, ...], ...]
    joint_rates: tuple[tuple[float, ...], ...]
    unsettled: tuple[int, ...]
    properties: tuple[tuple[int, Properties], ...]
