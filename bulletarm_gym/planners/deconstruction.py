"""The deconstruction planner: takes a structure apart, which backwards is how to build it.

(paper, Expert Demonstrations)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bulletarm_gym.control.open_loop import APPROACH
from bulletarm_gym.geometry import Pose
from bulletarm_gym.placement import draw_until, free_pose
from bulletarm_gym.relations import is_top
from bulletarm_gym.scene import Item, Scene
from bulletarm_gym.tasks import CLOSED, OPEN, Waypoint
from bulletarm_gym.tasks.grasping import RELEASE, grasp_item

GAP = 0.04
"""Least distance (m) between blocks on the ground: an open finger comes down in it."""
SAME_LEVEL = 0.5
"""Blocks count as equally high where they differ by less than this share of their height."""

CLEARANCE = 0.005
"""Least height (m) of the open fingers' tips over the ground."""
UPRIGHT_SHARE = 0.9
"""Share of an item's height that a side it can be grasped by has at least."""


@dataclass(frozen=True)
class Relocation:
    """A block taken from a structure and put on the ground.

    :param before: its pose in the structure
    :param after: its pose on the ground
    :param carried: its pose in the frame of the fingertips on the way
    """

    before: Pose
    after: Pose
    carried: Pose

    def reversed(self) -> tuple[Waypoint, Waypoint]:
        """Return the pick and the place that bring the block back."""
        hand = self.carried.inverse()
        above = self.before.compose(Pose((0.0, 0.0, RELEASE)))
        return (
            Waypoint(self.after.compose(hand), OPEN, finish=CLOSED),
            Waypoint(above.compose(hand), CLOSED, finish=OPEN),
        )


def take_apart(scene: Scene, rng: np.random.Generator) -> list[Relocation]:
    """Take a structure apart, one block after the other, from the top; the last stays where it is.

    The blocks are moved without the arm: whether it can do what they do is for the reversed actions to show.

    :param scene: what is loose in it is the structure
    :param rng: chooses among equally high blocks, and where they go
    :return: what was done, in this order
    :raises PlacementError: there is no room on the ground
    """
    standing = [item for item in scene if item.spec.mass > 0.0]
    relocations = []
    while len(standing) > 1:
        item = _next(standing, rng)
        standing.remove(item)
        relocations.append(_relocate(scene, rng, item))
    return relocations


def _relocate(scene: Scene, rng: np.random.Generator, item: Item) -> Relocation:
    """Put a block on the ground, where it can be grasped as in the structure."""
    before = item.pose
    carried = _grasp(scene, item).inverse().compose(before)
    after = draw_until(
        lambda: free_pose(scene, rng, item, GAP),
        lambda pose: _has_room(scene, pose.compose(carried.inverse())),
    )
    item.place(after)
    return Relocation(before, after, carried)


def _next(standing: Sequence[Item], rng: np.random.Generator) -> Item:
    """Return one of the highest blocks of those that none is above."""
    free = [item for item in standing if is_top(item, standing)]
    highest = max(item.pose.z for item in free)
    level = [item for item in free if highest - item.pose.z < SAME_LEVEL * item.spec.extents[2]]
    return level[int(rng.integers(len(level)))]


def _grasp(scene: Scene, item: Item) -> Pose:
    """Return where the fingertips grasp a block."""
    way = grasp_item(scene, item, *_grip(item, scene.robot.model.gripper.stroke))
    return next(waypoint.pose for waypoint in way if waypoint.finish is not None)


def _has_room(scene: Scene, hand: Pose) -> bool:
    """Whether the gripper gets to a pose, and the ground is below its open fingers there."""
    gripper = scene.robot.model.gripper
    reach = gripper.stroke / 2.0 + gripper.finger[0]
    fingers = [hand.transform((side * reach, 0.0, 0.0)) for side in (-1.0, 1.0)]
    behind = hand.compose(Pose((0.0, 0.0, APPROACH)))
    return (
        all(scene.surface.height((x, y)) < z - CLEARANCE for x, y, z in fingers)
        and scene.robot.reaches(hand)
        and scene.robot.reaches(behind)
    )


def _grip(item: Item, stroke: float) -> tuple[float, float]:
    """Return a yaw (rad) along which fingers can close on an item, and the turn to the next such yaw.

    They close on upright sides that are opposite each other and near enough.
    """
    points = item.spec.mesh.vertices
    low, high = points.min(axis=0), points.max(axis=0)

    def is_graspable(axis: int) -> bool:
        sides = [points[np.isclose(points[:, axis], limit[axis]), 2] for limit in (low, high)]
        upright = all(np.ptp(side) > UPRIGHT_SHARE * (high - low)[2] for side in sides)
        return upright and bool((high - low)[axis] < stroke)

    along_x, along_y = is_graspable(0), is_graspable(1)
    yaw = item.pose.yaw + (0.0 if along_x else math.pi / 2.0)
    return yaw, math.pi / 2.0 if along_x and along_y else math.pi
