"""Bringing the gripper to a block."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.waypoints import OPEN, Waypoint
from bulletarm_gym.geometry import Pose, wrap_angle
from bulletarm_gym.objects import cube
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.task import Task

REACHED = 0.03
"""Distance (m) that counts as reached (paper, Block Reaching)."""
YAW_SPREAD = math.pi / 2.0
BORDER_MARGIN = 1.2
"""Distance of a cube's centre to the border, in largest cube sides."""


class BlockReaching(Task):
    """Move the fingertips to a cube.

    Description: one 5 cm cube stands on the floor.
    Randomisation: the cube's position in the workspace, its yaw in +-90 degrees.
    Success: the fingertips are within 3 cm of the cube's centre.
    Expert: straight to the cube's centre.
    """

    defaults = TaskDefaults(num_objects=1)
    controls = (CLOSE_LOOP,)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cube."""
        return [scaled(config, "cube", cube)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the cube anywhere."""
        place_cube(scene, rng, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Compare the fingertips with the cube's centre."""
        reached = math.dist(scene.robot.pose.position, scene["cube"].pose.position) < REACHED
        return {"success": reached}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Go to the cube."""
        target, hand = scene["cube"].pose, scene.robot.pose
        turn = wrap_angle(target.yaw - hand.yaw, math.pi / 2.0)
        yield Waypoint(Pose.planar(*target.position, hand.yaw + turn), OPEN)


def place_cube(scene: Scene, rng: np.random.Generator, spread: float) -> None:
    """Put the scene's one cube anywhere in the workspace, with a yaw in +-``spread`` (rad)."""
    item = scene["cube"]
    (point,) = scatter(scene, rng, [BORDER_MARGIN * item.spec.extents[0]], 0.0)
    stand(scene, item, point, rng, spread)
