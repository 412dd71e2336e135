"""Pushing a block onto a goal area."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.pushing import Drag
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import Rectangle, planar_distance
from bulletarm_gym.objects import cube, goal_area
from bulletarm_gym.observations import Overlay
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.reaching import BORDER_MARGIN
from bulletarm_gym.tasks.task import Task

GOAL_SIDE = 0.09
"""Side (m) of the goal area (paper, Block Pushing)."""
GOAL_RISE = 0.02
"""By how much (m) the heightmap shows the goal nearer the camera."""
GOAL_BORDER = 0.065
"""Distance (m) of the goal's centre to the border."""
APART = 0.09
"""Least distance (m) of cube and goal at the start."""
GOAL_REACHED = 0.05
"""Distance (m) of the cube's centre to the goal's that counts as reached (paper, Block Pushing)."""
PUSH_HEIGHT = 0.015
"""Height (m) of the fingertips during a push: below the middle of a cube, which would tip over otherwise."""
YAW_SPREAD = math.pi / 2.0


class BlockPushing(Task):
    """Push a cube onto a goal area.

    Description: a 5 cm cube stands on the floor, on which a square of 9 x 9 cm is the goal. The heightmap
    shows the square 2 cm nearer the camera. The lengths of the goal shrink with smaller cubes.
    Randomisation: the positions of cube and goal, at least 9 cm apart, the cube's yaw in +-90 degrees; with a
    fixed orientation both lie along y.
    Success: the cube's centre is within 5 cm of the goal's.
    Expert: down behind the cube, and with it to the goal.
    """

    defaults = TaskDefaults(num_objects=1)
    controls = (CLOSE_LOOP,)

    @property
    def _scale(self) -> float:
        """Scale of the goal's lengths: that of the largest cube, at most 1."""
        return min(1.0, max(self.config.scales))

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cube and the mark of the goal area."""
        return [
            scaled(config, "cube", cube),
            ObjectSlot("goal", (goal_area("goal", self._scale * GOAL_SIDE),)),
        ]

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return nothing: the cube is pushed."""
        return []

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put cube and goal apart."""
        item, goal = scene["cube"], scene["goal"]
        margins = [self._scale * GOAL_BORDER, BORDER_MARGIN * item.spec.extents[0]]
        aligned = not self.config.random_orientation
        goal_point, point = scatter(scene, rng, margins, self._scale * APART, aligned=aligned)
        goal.place(scene.surface.pose(goal_point, 0.0))
        stand(scene, item, point, rng, YAW_SPREAD)

    def overlays(self, scene: Scene) -> tuple[Overlay, ...]:
        """Return the goal area."""
        pose, side = scene["goal"].pose, self._scale * GOAL_SIDE
        return (Overlay(Rectangle(pose.x, pose.y, side, side, pose.yaw), GOAL_RISE),)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Compare the cube's place with the goal's."""
        apart = planar_distance(scene["cube"].pose.position, scene["goal"].pose.position)
        return {"success": apart < self._scale * GOAL_REACHED}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Go behind the cube, and push."""
        yield from Drag(scene, scene["cube"], scene["goal"].pose.position, self._scale * PUSH_HEIGHT).plan()
