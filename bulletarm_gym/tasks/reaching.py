"""Moving the gripper to a block."""

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
"""Distance of a cube's centre to the border, relative to the largest cube's side."""


class BlockReaching(Task):
    """Move the fingertips to a cube.

    Description: one 5 cm cube stands on the surface.
    Randomisation: the cube's position in the workspace, its yaw in +-90 degrees.
    Success: the fingertips are within 3 cm of the cube's centre.
    Expert: move straight to the cube's centre.
    """

    defaults = TaskDefaults(num_objects=1)
    controls = (CLOSE_LOOP,)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cube."""
        return [scaled(config, "cube", cube)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cube."""
        place_cube(scene, rng, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the fingertips are near the cube's centre."""
        distance = math.dist(scene.robot.pose.position, scene["cube"].pose.position)
        return {"success": distance < REACHED}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Move to the cube."""
        target, tool = scene["cube"].pose, scene.robot.pose
        rotation = wrap_angle(target.yaw - tool.yaw, math.pi / 2.0)
        yield Waypoint(Pose.planar(*target.position, tool.yaw + rotation), OPEN)


def place_cube(scene: Scene, rng: np.random.Generator, spread: float) -> None:
    """Place the scene's cube in the workspace, with a yaw in +-``spread`` (rad)."""
    block = scene["cube"]
    (point,) = scatter(scene, rng, [BORDER_MARGIN * block.spec.extents[0]], 0.0)
    stand(scene, block, point, rng, spread)
