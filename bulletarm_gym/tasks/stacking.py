"""Stacking blocks."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError, TaskDefaults
from bulletarm_gym.experts.approach import PASSING
from bulletarm_gym.experts.towers import Tower
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.objects import cube
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.placement import scatter, stand
from bulletarm_gym.relations import at_rest, is_empty, stacked
from bulletarm_gym.scene import Item, Role, Scene, scaled
from bulletarm_gym.tasks.reaching import BORDER
from bulletarm_gym.tasks.structure import SCALE, Structure
from bulletarm_gym.tasks.task import Task

GAP = 2.4
"""Least distance of the blocks' centres, in largest block sides, as in the original BulletArm release."""
YAW_SPREAD = math.pi / 4.0
LEAST_BLOCKS = 2


class BlockStacking(Task):
    """Stack all cubes.

    Description: two (up to four) 5 cm cubes stand on the floor.
    Randomisation: the cubes' positions in the workspace, at least 2.4 sides apart, their yaws in +-45
    degrees.
    Success: the cubes form one stack; the gripper is empty and nothing moves.
    Expert: grasp a cube, up, over the tallest stack there is, down, open; and so on.
    """

    defaults = TaskDefaults(num_objects=2, allowed_objects=(2, 3, 4))
    controls = (CLOSE_LOOP,)

    def bodies(self, config: EnvConfig) -> list[Role]:
        """Return the cubes.

        :raises ParameterError: the stack is too high for the workspace
        """
        check_height(config)
        return [scaled(config, f"cube {number}", cube) for number in range(config.num_objects)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the cubes apart."""
        scatter_blocks(scene, rng, scene.items, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the cubes are stacked, and whether all is done."""
        facts = {
            "is_stacked": stacked(scene, scene),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Put one cube after the other on the tallest stack."""
        yield from Tower(scene, scene.items).plan()


class OpenLoopBlockStacking(Structure):
    """Stack all cubes, by pick and place.

    Description: four (two to six) 3 cm cubes lie on the ground.
    Success: the cubes form one stack.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(num_objects=4, max_steps=10, object_scale=SCALE, allowed_objects=(2, 3, 4, 5, 6))
    kinds = {"cube": cube}  # noqa: RUF012

    def __init__(self, config: EnvConfig) -> None:
        check_height(config)
        self.layers = [("cube",)] * config.num_objects
        super().__init__(config)


def scatter_blocks(scene: Scene, rng: np.random.Generator, items: list[Item], spread: float) -> None:
    """Stand blocks apart, with room for the gripper between them, their yaws in +-``spread`` (rad)."""
    side = max(item.spec.extents[0] for item in items)
    points = scatter(scene, rng, [BORDER * side] * len(items), GAP * side)
    for item, point in zip(items, points, strict=True):
        stand(scene, item, point, rng, spread)


def check_height(config: EnvConfig) -> None:
    """Check that the gripper can bring the last block over all the others.

    :raises ParameterError: it cannot
    """
    side, top = CUBE_SIZE * max(config.scales), config.workspace[2][1]
    most = int((top - PASSING) / side + 0.5)
    if most < LEAST_BLOCKS:
        takes = f"one high enough to put one block of {side:.3f} m on another"
        raise ParameterError.of("workspace", config.workspace, takes)
    if config.num_objects > most:
        takes = f"at most {most} blocks of {side:.3f} m in a workspace {top:.3f} m high"
        raise ParameterError.of("num_objects", config.num_objects, takes)
