"""Building a house."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.objects import cube, triangle
from bulletarm_gym.placement import stack_up
from bulletarm_gym.relations import at_rest, is_empty, is_top, stacked, upright
from bulletarm_gym.scene import Role, Scene, scaled
from bulletarm_gym.tasks.building import Tower
from bulletarm_gym.tasks.stacking import OPEN_LOOP_SCALE, check_height, scatter_blocks
from bulletarm_gym.tasks.task import Task, Waypoint

YAW_SPREAD = math.pi / 2.0
ROOF = "triangle"


class HouseBuilding(Task):
    """Stack the cubes, and put the triangle on top.

    Description: one (up to three) 5 cm cubes and a triangle, 5 x 5 x 5 cm, stand on the floor.
    Randomisation: the blocks' positions in the workspace, at least 2.4 sides apart, their yaws in +-90
    degrees.
    Success: the blocks form one stack, on top the triangle, upright; the gripper is empty and nothing moves.
    Expert: grasp a block, the triangle last, up, over the stack, down, open; and so on.
    """

    defaults = TaskDefaults(num_objects=2, allowed_objects=(2, 3, 4))
    controls = (CLOSE_LOOP,)

    def bodies(self, config: EnvConfig) -> list[Role]:
        """Return the cubes and the triangle.

        :raises ParameterError: the house is too high for the workspace
        """
        check_height(config)
        cubes = [scaled(config, f"cube {number}", cube) for number in range(config.num_objects - 1)]
        return [*cubes, scaled(config, ROOF, triangle)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the blocks apart."""
        scatter_blocks(scene, rng, scene.items, YAW_SPREAD)

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        """Stack the cubes, and put the triangle on top."""
        stack_up(scene, rng, scene.items)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the blocks are stacked in their order, and whether all is done."""
        roof = scene[ROOF]
        facts = {
            "is_stacked": stacked(scene, scene),
            "is_roof_upright": upright(roof),
            "is_roof_on_top": is_top(roof, scene.items),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Put one cube after the other on the tallest stack, then the triangle."""
        roof = scene[ROOF]
        yield from Tower(scene, [item for item in scene if item is not roof], roof).plan()


class HouseBuilding1(HouseBuilding):
    """Stack the cubes, and put the triangle on top, by pick and place.

    Description: three (one to five) 3 cm cubes and a triangle, 3 x 3 x 3 cm, stand on the ground.
    Validity: the triangle has not fallen over; the gripper cannot right it.
    All else is as in :class:`HouseBuilding`.
    """

    defaults = TaskDefaults(
        num_objects=4, max_steps=10, object_scale=OPEN_LOOP_SCALE, allowed_objects=(2, 3, 4, 5, 6)
    )
    controls = (OPEN_LOOP,)

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace and the triangle stands upright."""
        return super().is_valid(scene) and upright(scene[ROOF])
