"""Stacking blocks."""

import math
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError, TaskDefaults
from bulletarm_gym.experts.approach import PASSING
from bulletarm_gym.experts.towers import Tower
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.objects import cube
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import at_rest, is_empty, is_top, stacked, upright
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.reaching import BORDER_MARGIN
from bulletarm_gym.tasks.structure import SCALE, Structure
from bulletarm_gym.tasks.task import Task

CENTRE_SPACING = 2.4
"""Least distance of the blocks' centres, in largest block sides."""
LEAST_BLOCKS = 2


class Stack(Structure):
    """A structure one block wide: cubes, and maybe a crown.

    In open loop all is as in :class:`~bulletarm_gym.tasks.structure.Structure`. In close loop:

    Randomisation: the blocks' positions in the workspace, at least 2.4 sides apart, their yaws.
    Success: the blocks form one stack, the crown, if there is one, on top and upright; the gripper is empty
    and nothing moves.
    Expert: grasp a block, the crown last, up, over the tallest stack there is, down, open; and so on.
    """

    defaults = TaskDefaults(
        num_objects=4,
        max_steps=10,
        object_scale=SCALE,
        allowed_objects=(2, 3, 4, 5, 6),
        close_loop={"max_steps": 100},
    )
    spread: ClassVar[float]
    """Greatest yaw (rad) of a block either way at the start, in close loop."""
    crown: ClassVar[str | None] = None
    """Kind of the uppermost block, if it is another."""

    def __init__(self, config: EnvConfig) -> None:
        check_height(config)
        cubes = config.num_objects - (self.crown is not None)
        self.layers = [("cube",)] * cubes + ([] if self.crown is None else [(self.crown,)])
        super().__init__(config)

    @property
    def _is_close_loop(self) -> bool:
        return self.config.control == CLOSE_LOOP

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the blocks apart."""
        if self._is_close_loop:
            scatter_blocks(scene, rng, scene.objects, self.spread)
        else:
            super().arrange(scene, rng)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the blocks are stacked in their order, and whether all is done."""
        if not self._is_close_loop:
            return super().evaluate(scene)
        facts = {"is_stacked": stacked(scene, scene)}
        if (crown := self._crown(scene)) is not None:
            facts["is_roof_upright"] = upright(crown)
            facts["is_roof_on_top"] = is_top(crown, scene.objects)
        facts |= {"is_empty": is_empty(scene), "is_at_rest": at_rest(scene)}
        return {"success": all(facts.values()), **facts}

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace and, in open loop, nothing has fallen over."""
        return Task.is_valid(self, scene) if self._is_close_loop else super().is_valid(scene)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Put one cube after the other on the tallest stack, then the crown."""
        if self._is_close_loop:
            crown = self._crown(scene)
            yield from Tower(scene, [item for item in scene if item is not crown], crown).plan()
        else:
            yield from super().plan(scene, rng)

    def _crown(self, scene: Scene) -> SceneObject | None:
        return None if self.crown is None else self.blocks(scene)[self.crown][0]


class BlockStacking(Stack):
    """Stack all cubes.

    Description: four (two to six) 3 cm cubes lie on the ground; in the paper's close-loop task two of 5 cm.
    Randomisation: the cubes' positions and yaws, in open loop at least 4.2 cm between any two, in close loop
    at least 2.4 sides apart and yaws within 45 degrees either way.
    Success: the cubes form one stack; the gripper is empty and nothing moves.
    Expert: in open loop pick a cube and place it on the tallest stack there is, in close loop grasp it, up,
    over the stack, down, open; and so on.
    All else is as in :class:`Stack`.
    """

    kinds = {"cube": cube}  # noqa: RUF012
    spread = math.pi / 4.0


def scatter_blocks(scene: Scene, rng: np.random.Generator, items: list[SceneObject], spread: float) -> None:
    """Stand blocks apart, with room for the gripper between them, their yaws in +-``spread`` (rad)."""
    side = max(item.spec.extents[0] for item in items)
    points = scatter(scene, rng, [BORDER_MARGIN * side] * len(items), CENTRE_SPACING * side)
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
