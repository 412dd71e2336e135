"""Deconstruction planner (paper, Expert Demonstrations): the reversal of taking a structure apart."""

import numpy as np

from bulletarm_gym.control.open_loop import MOTION
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import RELEASE
from bulletarm_gym.experts.pick_place import fingers_fit, pick
from bulletarm_gym.geometry import Pose
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import is_top, loose_objects
from bulletarm_gym.scene.sampling import free_pose, sample_until

GRASP_CLEARANCE = 0.04
"""Smallest gap (m) between blocks on the surface, for an open finger."""
SAME_LEVEL = 0.5
"""Largest height difference of blocks at the same level, relative to their height."""


def deconstruct(scene: Scene, rng: np.random.Generator) -> list[Waypoint]:
    """Move all blocks of a structure but the last to the surface, from the top, without the arm.

    :param scene: scene whose loose objects are the structure
    :param rng: samples the order of blocks at the same level and their new poses
    :return: alternating picks and places that build the structure again; they may fail
    :raises PlacementError: the surface has no space for a block
    """
    remaining = loose_objects(scene)
    plan: list[Waypoint] = []
    while len(remaining) > 1:
        free = [block for block in remaining if is_top(block, remaining)]
        highest = max(block.pose.z for block in free)
        level = [block for block in free if highest - block.pose.z < SAME_LEVEL * block.spec.extents[2]]
        block = level[int(rng.integers(len(level)))]
        remaining.remove(block)
        plan = [*_relocate(scene, rng, block), *plan]
    return plan


def _relocate(scene: Scene, rng: np.random.Generator, block: SceneObject) -> tuple[Waypoint, Waypoint]:
    """Place a block on the surface; return the pick and the place that move it back with the same grasp."""
    before = block.pose
    in_block = pick(scene, block, rng).pose.inverse().compose(before).inverse()

    def is_graspable(pose: Pose) -> bool:
        tool = pose.compose(in_block)
        start = tool.compose(Pose((0.0, 0.0, MOTION.approach)))
        return fingers_fit(scene, tool, block) and scene.robot.reaches(tool) and scene.robot.reaches(start)

    after = sample_until(lambda: free_pose(scene, rng, block, GRASP_CLEARANCE), is_graspable)
    block.place(after)
    above = before.compose(Pose((0.0, 0.0, RELEASE)))
    return (
        Waypoint(after.compose(in_block), OPEN, finish=CLOSED),
        Waypoint(above.compose(in_block), CLOSED, finish=OPEN),
    )
