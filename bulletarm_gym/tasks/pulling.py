"""Pulling a block to another without lifting it."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.pushing import Drag
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.objects import flat_block
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import touching
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.task import Task

YAW_SPREAD = math.pi / 2.0
BORDER_MARGIN = 0.85
"""Distance of a block's centre to the border, relative to the block's side."""
CENTRE_SPACING = 1.7
"""Smallest distance between the blocks' centres, relative to the block's side."""
PULL_HEIGHT = 0.03
"""Height (m) of the fingertips while they pull."""


class BlockPulling(Task):
    """Pull one of two blocks until it touches the other.

    Description: two blocks of 8 x 8 x 5 cm stand on the surface, too wide for the gripper.
    Randomisation: the blocks' positions in the workspace, at least 1.7 sides apart, their yaws in +-90
    degrees; with a fixed orientation both lie along y, side by side.
    Success: the blocks touch.
    Expert: move above the far side of a block, lower behind it, pull it to the other.
    """

    defaults = TaskDefaults(num_objects=2, object_scale=0.8, allowed_objects=(2,))
    controls = (CLOSE_LOOP,)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the two blocks."""
        return [scaled(config, name, flat_block) for name in ("near block", "far block")]

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return nothing: the blocks are pulled from behind."""
        return []

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the blocks apart."""
        side = max(block.spec.extents[0] for block in scene.objects)
        aligned = not self.config.random_orientation
        points = scatter(scene, rng, [BORDER_MARGIN * side] * 2, CENTRE_SPACING * side, aligned)
        for block, point in zip(scene.objects, points, strict=True):
            stand(scene, block, point, rng, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the blocks touch."""
        return {"success": touching(scene, *scene.objects)}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Pull the block with the shorter path to the other block."""
        first, second = scene.objects
        drags = [
            Drag(scene, block, goal.pose.position, PULL_HEIGHT)
            for block, goal in ((first, second), (second, first))
        ]
        yield from min(drags, key=lambda drag: drag.effort).plan()
