"""Building houses."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.towers import Tower
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.objects.blocks import brick, cube, roof, triangle
from bulletarm_gym.relations import at_rest, is_empty, is_top, stacked, upright
from bulletarm_gym.scene import Role, Scene, scaled
from bulletarm_gym.tasks.stacking import check_height, scatter_blocks
from bulletarm_gym.tasks.structure import SCALE, Structure
from bulletarm_gym.tasks.task import Task

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


class HouseBuilding1(Structure):
    """Stack the cubes, and put the triangle on top, by pick and place.

    Description: three (one to five) 3 cm cubes and a triangle, 3 x 3 x 3 cm, lie on the ground.
    Success: the cubes form a stack, on top the triangle.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(num_objects=4, max_steps=10, object_scale=SCALE, allowed_objects=(2, 3, 4, 5, 6))
    kinds = {"cube": cube, "triangle": triangle}  # noqa: RUF012
    upright = ("triangle",)

    def __init__(self, config: EnvConfig) -> None:
        check_height(config)
        self.layers = [*[("cube",)] * (config.num_objects - 1), ("triangle",)]
        super().__init__(config)


class HouseBuilding2(Structure):
    """Two cubes side by side, the roof on both.

    Description: two 3 cm cubes and a roof, 12 x 3 x 3 cm, lie on the ground.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(num_objects=3, max_steps=10, object_scale=SCALE, allowed_objects=(3,))
    kinds = {"cube": cube, "roof": roof}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("roof",))
    upright = ("roof",)


class HouseBuilding3(HouseBuilding2):
    """Two cubes side by side, the brick on both, the roof on the brick.

    Description: two 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the ground.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(num_objects=4, max_steps=10, object_scale=SCALE, allowed_objects=(4,))
    kinds = {**HouseBuilding2.kinds, "brick": brick}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("brick",), ("roof",))


class HouseBuilding4(HouseBuilding3):
    """Two cubes side by side, the brick on both, two more cubes on the brick, the roof on those.

    Description: four 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the ground.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(num_objects=6, max_steps=20, object_scale=SCALE, allowed_objects=(6,))
    layers = (("cube", "cube"), ("brick",), ("cube", "cube"), ("roof",))
