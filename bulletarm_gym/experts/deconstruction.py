"""The deconstruction planner: takes a structure apart, which backwards is how to build it.

(paper, Expert Demonstrations)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bulletarm_gym.control.open_loop import MOTION
from bulletarm_gym.experts.approach import RELEASE
from bulletarm_gym.experts.pick_place import fingers_fit, pick
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import is_top
from bulletarm_gym.scene.sampling import free_pose, sample_until

GRASP_CLEARANCE = 0.04
"""Least distance (m) between blocks on the ground: an open finger comes down in it."""
SAME_LEVEL = 0.5
"""Blocks count as equally high where they differ by less than this share of their height."""


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


def deconstruct(scene: Scene, rng: np.random.Generator) -> list[Relocation]:
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


def _relocate(scene: Scene, rng: np.random.Generator, item: SceneObject) -> Relocation:
    """Put a block on the ground, where it can be grasped as in the structure."""
    before = item.pose
    carried = pick(scene, item, rng).pose.inverse().compose(before)

    def is_in_reach(pose: Pose) -> bool:
        hand = pose.compose(carried.inverse())
        behind = hand.compose(Pose((0.0, 0.0, MOTION.approach)))
        return fingers_fit(scene, hand, item) and scene.robot.reaches(hand) and scene.robot.reaches(behind)

    after = sample_until(lambda: free_pose(scene, rng, item, GRASP_CLEARANCE), is_in_reach)
    item.place(after)
    return Relocation(before, after, carried)


def _next(standing: Sequence[SceneObject], rng: np.random.Generator) -> SceneObject:
    """Return one of the highest blocks of those that none is above."""
    free = [item for item in standing if is_top(item, standing)]
    highest = max(item.pose.z for item in free)
    level = [item for item in free if highest - item.pose.z < SAME_LEVEL * item.spec.extents[2]]
    return level[int(rng.integers(len(level)))]
