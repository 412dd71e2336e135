"""Deconstruction planner: a structure is built by reversing how it is taken apart (paper, Expert
Demonstrations).
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
"""Smallest gap (m) between blocks on the surface, for an open finger."""
SAME_LEVEL = 0.5
"""Largest height difference of blocks at the same level, relative to their height."""


@dataclass(frozen=True)
class Relocation:
    """A block that was moved from a structure to the surface.

    :param before: pose of the block in the structure
    :param after: pose of the block on the surface
    :param carried: pose of the grasped block in the frame of the fingertips
    """

    before: Pose
    after: Pose
    carried: Pose

    def reversed(self) -> tuple[Waypoint, Waypoint]:
        """Return the pick and the place that move the block back into the structure."""
        tool = self.carried.inverse()
        above = self.before.compose(Pose((0.0, 0.0, RELEASE)))
        return (
            Waypoint(self.after.compose(tool), OPEN, finish=CLOSED),
            Waypoint(above.compose(tool), CLOSED, finish=OPEN),
        )


def deconstruct(scene: Scene, rng: np.random.Generator) -> list[Relocation]:
    """Move all blocks of a structure but the last to the surface, from the top, without the arm.

    The reversed actions may fail.

    :param scene: scene whose loose objects are the structure
    :param rng: samples the order of blocks at the same level and their new poses
    :return: the relocations in their order
    :raises PlacementError: the surface has no space for a block
    """
    remaining = [obj for obj in scene if obj.spec.mass > 0.0]
    relocations = []
    while len(remaining) > 1:
        block = _next(remaining, rng)
        remaining.remove(block)
        relocations.append(_relocate(scene, rng, block))
    return relocations


def _relocate(scene: Scene, rng: np.random.Generator, block: SceneObject) -> Relocation:
    """Place a block on the surface, where the same grasp as in the structure is possible."""
    before = block.pose
    carried = pick(scene, block, rng).pose.inverse().compose(before)

    def is_graspable(pose: Pose) -> bool:
        tool = pose.compose(carried.inverse())
        start = tool.compose(Pose((0.0, 0.0, MOTION.approach)))
        return fingers_fit(scene, tool, block) and scene.robot.reaches(tool) and scene.robot.reaches(start)

    after = sample_until(lambda: free_pose(scene, rng, block, GRASP_CLEARANCE), is_graspable)
    block.place(after)
    return Relocation(before, after, carried)


def _next(remaining: Sequence[SceneObject], rng: np.random.Generator) -> SceneObject:
    """Sample one of the highest blocks that carry no other."""
    free = [block for block in remaining if is_top(block, remaining)]
    highest = max(block.pose.z for block in free)
    level = [block for block in free if highest - block.pose.z < SAME_LEVEL * block.spec.extents[2]]
    return level[int(rng.integers(len(level)))]
