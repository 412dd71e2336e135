"""Components of a user, some of them wrong."""

import dataclasses
import math
from functools import partial

import numpy as np
from gymnasium import spaces

from bulletarm_gym.control import CloseLoop
from bulletarm_gym.observations import Sensor
from bulletarm_gym.robots import KUKA
from bulletarm_gym.simulation import BodySpec, Box, Piece
from bulletarm_gym.surfaces import FlatSurface
from bulletarm_gym.tasks.picking import BlockPicking

NUMBER = 3


def arm():
    return dataclasses.replace(KUKA, name="arm")


class Raised(FlatSurface):
    slide = 0.0


class Backwards(CloseLoop):
    sequences = ("rzyxp", "zyxp")


class Kindless(CloseLoop):
    kind = "both"


class Picking(BlockPicking):
    """A goal in the memory, as a tuple."""

    def arrange(self, scene, rng):
        super().arrange(scene, rng)
        self.memory = (0.5, 0.1)

    def goals(self, scene):
        return scene.robot.pose.position[:2], self.memory

    def goal_error(self, achieved, desired):
        return math.dist(achieved, desired)


def brick(name, scale, width=0.03, pieces=None, **values):
    pieces = (Piece(Box((0.08 * scale, width * scale, 0.04 * scale))),) if pieces is None else pieces
    return BodySpec(name, pieces, **{"mass": 0.3, **values})


light = partial(brick, mass=-1.0)
slippery = partial(brick, friction=float("nan"))
opaque = partial(brick, colour=(1.0, 0.0, 0.0))
empty = partial(brick, pieces=())
flat = partial(brick, width=0.0)


def nothing(name, scale):
    return None


class Count(Sensor):
    """Number of actions, and by how much the last one raised the fingertips."""

    space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, scene, start=0):
        super().__init__(scene)
        self.start = start

    def read(self, view):
        count, height = self.memory or (self.start, view.frame.origin.z)
        return np.array([count, view.frame.origin.z - height], np.float32)

    def follow(self, before, pick):
        count, _ = self.memory or (self.start, 0.0)
        self.memory = (count + 1, before.frame.origin.z)


class Unfinished(Sensor):
    """Reads nothing."""


class Wrong(Sensor):
    space = spaces.Box(0.0, 1.0, (2,), np.float32)

    def read(self, view):
        return self.returned


Shape = type("Shape", (Wrong,), {"returned": np.zeros(3, np.float32)})
Type = type("Type", (Wrong,), {"returned": np.zeros(2)})
List = type("List", (Wrong,), {"returned": [0.0, 0.0]})
Discrete = type("Discrete", (Wrong,), {"space": spaces.Discrete(2)})
