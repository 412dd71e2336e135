"""Pushing a block onto a goal area, and pulling a block to another."""

import math
from collections.abc import Iterator
from itertools import permutations

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.pushing import Drag
from bulletarm_gym.geometry import FloatArray, Rectangle, planar_distance
from bulletarm_gym.objects import cube, flat_block, goal_area
from bulletarm_gym.observations.view import Overlay
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.predicates import TOUCHING, touching
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.picking import BORDER_MARGIN
from bulletarm_gym.tasks.task import Task

GOAL_SIDE = 0.09
"""Side (m) of the goal area (paper, Block Pushing)."""
GOAL_RISE = 0.02
"""Distance (m) by which the heightmap shows the goal nearer the camera."""
GOAL_BORDER = 0.065
"""Distance (m) of the goal's centre to the border."""
APART = 0.09
"""Smallest distance (m) between cube and goal at the start."""
GOAL_REACHED = 0.05
"""Distance (m) between the centres of cube and goal that counts as reached (paper, Block Pushing)."""
PUSH_HEIGHT = 0.015
"""Height (m) of the fingertips during a push, below a cube's centre so that it does not tip over."""
PULL_BORDER_MARGIN = 0.85
"""Distance of a block's centre to the border, relative to the block's side."""
PULL_SPACING = 1.7
"""Smallest distance between the blocks' centres, relative to the block's side."""
FAR = 10.0
"""Largest gap (m) between blocks that is measured, more than the reach of any arm."""
PULL_HEIGHT = 0.03
"""Height (m) of the fingertips while they pull."""


class BlockPushing(Task):
    """Push a cube onto a goal area.

    Description: a 5 cm cube stands on the surface, on which a square of 9 x 9 cm is the goal. The heightmap
    shows the square 2 cm nearer the camera. The lengths of the goal shrink with smaller cubes.
    Randomisation: the positions of cube and goal, at least 9 cm apart, the cube's yaw in +-90 degrees; with a
    fixed orientation both lie along y.
    Success: the cube's centre is within 5 cm of the goal's.
    Expert: lower the gripper behind the cube, push it to the goal.
    """

    instructions = ("Push a cube onto a goal area{surface}.", "Push the cube to the goal{surface}.")
    defaults = TaskDefaults(num_objects=1)
    controls = (CLOSE_LOOP,)
    grasps = False
    pushes = True

    @property
    def _scale(self) -> float:
        """Scale of the goal's lengths: that of the largest cube, at most 1."""
        return min(1.0, max(self.config.scales))

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        goal = goal_area("goal", self._scale * GOAL_SIDE)
        return [scaled(config, "cube", cube), ObjectSlot("goal", (goal,))]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        block, goal = scene["cube"], scene["goal"]
        margins = [self._scale * GOAL_BORDER, BORDER_MARGIN * block.spec.extents[0]]
        aligned = not self.config.random_orientation
        goal_point, point = scatter(scene, rng, margins, self._scale * APART, aligned)
        goal.place(scene.surface.pose(goal_point, 0.0))
        stand(scene, block, point, rng, math.pi / 2.0)

    def overlays(self, scene: Scene) -> tuple[Overlay, ...]:
        pose, side = scene["goal"].pose, self._scale * GOAL_SIDE
        return (Overlay(Rectangle(pose.x, pose.y, side, side, pose.yaw), GOAL_RISE),)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        distance = planar_distance(scene["cube"].pose.position, scene["goal"].pose.position)
        return {"success": distance < self._scale * GOAL_REACHED}

    def goals(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Return the positions (m) of the cube's centre and of the goal's in x and y, (2,) each."""
        return np.array(scene["cube"].pose.position[:2]), np.array(scene["goal"].pose.position[:2])

    def goal_error(self, achieved: FloatArray, desired: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(achieved - desired, axis=-1) / (self._scale * GOAL_REACHED))

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        yield from Drag(scene, scene["cube"], scene["goal"].pose.position, self._scale * PUSH_HEIGHT).plan()


class BlockPulling(Task):
    """Pull one of two blocks until it touches the other.

    Description: two blocks of 8 x 8 x 5 cm stand on the surface, too wide for the gripper.
    Randomisation: the blocks' positions in the workspace, at least 1.7 sides apart, their yaws in +-90
    degrees; with a fixed orientation both lie along y, side by side.
    Success: the blocks touch.
    Expert: move above the far side of a block, lower behind it, pull it to the other.
    """

    instructions = (
        "Pull one of two blocks{surface} until it touches the other.",
        "Pull the blocks{surface} together.",
    )
    defaults = TaskDefaults(num_objects=2, object_scale=0.8, allowed_objects=(2,))
    controls = (CLOSE_LOOP,)
    grasps = False
    pushes = True

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        return [scaled(config, name, flat_block) for name in ("near block", "far block")]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        side = max(block.spec.extents[0] for block in scene.objects)
        aligned = not self.config.random_orientation
        points = scatter(scene, rng, [PULL_BORDER_MARGIN * side] * 2, PULL_SPACING * side, aligned)
        for block, point in zip(scene.objects, points, strict=True):
            stand(scene, block, point, rng, math.pi / 2.0)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        return {"success": touching(scene, *scene.objects)}

    def goals(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Return the gap (m) between the blocks, at least 0, and 0, (1,) each."""
        first, second = (block.body for block in scene.objects)
        return np.array([max(scene.world.distance(first, second, FAR), 0.0)]), np.zeros(1)

    def goal_error(self, achieved: FloatArray, desired: FloatArray) -> FloatArray:
        return np.asarray(np.abs(achieved - desired)[..., 0] / TOUCHING)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        pairs = permutations(scene.objects)
        drags = [Drag(scene, block, goal.pose.position, PULL_HEIGHT) for block, goal in pairs]
        yield from min(drags, key=lambda drag: drag.effort).plan()
