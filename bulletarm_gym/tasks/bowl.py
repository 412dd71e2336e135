"""Putting a block into a bowl."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.approach import grasp_object, place_object, side_yaw
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import planar_distance
from bulletarm_gym.objects import bowl, cube
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.objects.bowl import HEIGHT
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import is_held, success_at_rest, touching, upright
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.reaching import BORDER_MARGIN
from bulletarm_gym.tasks.task import Task

CENTRED = 0.03
"""Largest distance (m) of the cube's centre to the bowl's axis at success."""
BOWL_BORDER = 0.53
"""Distance of the bowl's axis to the border, relative to its diameter: 8.5 cm."""
RIM_CLEARANCE = 0.06
"""Distance (m) between the cube's centre and the bowl's rim, for the gripper's fingers."""
RELEASE_HEIGHT = 0.35
"""Height of the release relative to the bowl's height, where the open fingers still fit into the bowl."""
YAW_SPREAD = math.pi / 2.0


class BlockInBowl(Task):
    """Put a cube into a bowl.

    Description: a 5 cm cube and a bowl of 16 x 16 x 7 cm stand on the surface.
    Randomisation: the positions of both, with space for the gripper between them, their yaws in +-90 degrees.
    Success: the cube's centre is within 3 cm of the bowl's axis and the cube touches the bowl, which is
    upright; the gripper is empty and nothing moves.
    Expert: grasp the cube, lift, move above the bowl, lower, open.
    """

    defaults = TaskDefaults(num_objects=2, allowed_objects=(2,))
    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """Height (m) of the fingertips above the rim with half a cube below them."""
        return (HEIGHT + CUBE_SIZE / 2.0) * max(self.config.scales)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return cube and bowl."""
        return [scaled(config, "cube", cube), scaled(config, "bowl", bowl)]

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return the cube, not the bowl."""
        return [scene["cube"]]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place cube and bowl apart."""
        block, vessel = scene["cube"], scene["bowl"]
        margins = [BOWL_BORDER * vessel.spec.extents[0], BORDER_MARGIN * block.spec.extents[0]]
        vessel_point, point = scatter(scene, rng, margins, vessel.spec.planar_radius + RIM_CLEARANCE)
        stand(scene, vessel, vessel_point, rng, YAW_SPREAD)
        stand(scene, block, point, rng, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the cube is in the upright bowl, the gripper is empty and nothing moves."""
        block, vessel = scene["cube"], scene["bowl"]
        centred = planar_distance(block.pose.position, vessel.pose.position) < CENTRED
        return success_at_rest(
            scene, is_in_bowl=centred and touching(scene, block, vessel), is_upright=upright(vessel)
        )

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the cube, or release it in the bowl."""
        block, vessel = scene["cube"], scene["bowl"]
        if is_held(scene, block):
            height = vessel.lowest + RELEASE_HEIGHT * vessel.spec.extents[2]
            yield from place_object(scene, block, vessel.pose.position, height)
        else:
            yield from grasp_object(scene, block, side_yaw(block.pose), math.pi / 2.0)
