"""Putting a block into a bowl."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.approach import grasp_item, place_item, side_yaw
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import planar_distance
from bulletarm_gym.objects import bowl, cube
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.objects.containers import BOWL_HEIGHT
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import at_rest, is_empty, is_held, touching, upright
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.reaching import BORDER_MARGIN
from bulletarm_gym.tasks.task import Task

CENTRED = 0.03
"""Distance (m) of the cube's centre to the bowl's axis."""
BOWL_BORDER = 0.53
"""Distance of the bowl's axis to the border, in its diameters: 8.5 cm."""
RIM_CLEARANCE = 0.06
"""Room (m) between the cube's centre and the bowl's rim, for the gripper's fingers."""
RELEASE_HEIGHT = 0.35
"""Height at which the cube is let go, in bowl heights: there the open fingers still fit in."""
YAW_SPREAD = math.pi / 2.0


class BlockInBowl(Task):
    """Put a cube into a bowl.

    Description: a 5 cm cube and a bowl of 16 x 16 x 7 cm stand on the floor.
    Randomisation: the positions of both, with room for the gripper between them, their yaws in +-90 degrees.
    Success: the cube's centre is within 3 cm of the bowl's axis and the cube touches the bowl, which is
    upright; the gripper is empty and nothing moves.
    Expert: grasp the cube, up, over the bowl, down into it, open.
    """

    defaults = TaskDefaults(num_objects=2, allowed_objects=(2,))
    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """The gripper must get over the rim with half a cube below it."""
        return (BOWL_HEIGHT + CUBE_SIZE / 2.0) * max(self.config.scales)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return cube and bowl."""
        return [scaled(config, "cube", cube), scaled(config, "bowl", bowl)]

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return the cube: the bowl stays where it is."""
        return [scene["cube"]]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put cube and bowl apart."""
        item, vessel = scene["cube"], scene["bowl"]
        margins = [BOWL_BORDER * vessel.spec.extents[0], BORDER_MARGIN * item.spec.extents[0]]
        vessel_point, point = scatter(scene, rng, margins, vessel.spec.planar_radius + RIM_CLEARANCE)
        stand(scene, vessel, vessel_point, rng, YAW_SPREAD)
        stand(scene, item, point, rng, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look where the cube is, how the bowl stands, and whether all is done."""
        item, vessel = scene["cube"], scene["bowl"]
        facts = {
            "is_in_bowl": planar_distance(item.pose.position, vessel.pose.position) < CENTRED
            and touching(scene, item, vessel),
            "is_upright": upright(vessel),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the cube, carry it over the bowl, let go inside."""
        item, vessel = scene["cube"], scene["bowl"]
        if is_held(scene, item):
            height = vessel.lowest + RELEASE_HEIGHT * vessel.spec.extents[2]
            yield from place_item(scene, item, vessel.pose.position, height)
        else:
            yield from grasp_item(scene, item, side_yaw(item.pose), math.pi / 2.0)
