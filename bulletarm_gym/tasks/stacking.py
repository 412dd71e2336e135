"""Stacking blocks."""

import math
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError
from bulletarm_gym.experts.approach import PASSING
from bulletarm_gym.experts.builder import Builder, TowerBuilder
from bulletarm_gym.objects import cube
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.scene import Scene
from bulletarm_gym.scene.predicates import is_top, stacked, success_at_rest, upright
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.picking import BORDER_MARGIN
from bulletarm_gym.tasks.structure import Structure, structure_defaults

CENTRE_SPACING = 2.4
"""Smallest distance between the blocks' centres, relative to the largest block's side."""


class Stack(Structure):
    """A stack of cubes, with a different block on top or without.

    Open-loop control: as in :class:`~bulletarm_gym.tasks.structure.Structure`. Closed-loop control:

    Randomisation: the blocks' positions in the workspace, at least 2.4 sides apart, and their yaws.
    Success: the blocks form one stack, the top block upright and above all others; the gripper is empty and
    nothing moves.
    Expert: repeat until solved: grasp the next block (the top block last), lift, move above the stack, lower,
    open.

    :param config: the environment's parameters
    """

    defaults = structure_defaults(4, allowed=(2, 3, 4, 5, 6))
    spread: ClassVar[float]
    """Largest absolute yaw (rad) of a block at the start under closed-loop control."""
    top: ClassVar[str] = ""
    """Kind of the block on the cubes; empty without one."""

    def __init__(self, config: EnvConfig) -> None:
        _check_height(config)
        self._is_close_loop = config.control == CLOSE_LOOP
        self.layers = [("cube",)] * (config.num_objects - bool(self.top)) + [(self.top,)] * bool(self.top)
        if self._is_close_loop:
            self.upright = ()  # an invalid scene would end the episode
        super().__init__(config)

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the blocks apart."""
        if not self._is_close_loop:
            super().arrange(scene, rng)
            return
        side = max(block.spec.extents[0] for block in scene.objects)
        margins = [BORDER_MARGIN * side] * len(scene.objects)
        points = scatter(scene, rng, margins, CENTRE_SPACING * side)
        for block, point in zip(scene.objects, points, strict=True):
            stand(scene, block, point, rng, self.spread)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the blocks are stacked in order, the gripper is empty and nothing moves."""
        if not self._is_close_loop:
            return super().evaluate(scene)
        facts = {"is_stacked": stacked(scene, scene)}
        if self.top:
            top = self.blocks(scene)[self.top][0]
            facts |= {"is_roof_upright": upright(top), "is_roof_on_top": is_top(top, scene.objects)}
        return success_at_rest(scene, **facts)

    def builder(self, scene: Scene, rng: np.random.Generator) -> Builder:
        """Return the planner of the stack."""
        kind = TowerBuilder if self._is_close_loop else Builder
        return kind(scene, self.blueprint, self.blocks(scene), rng)


class BlockStacking(Stack):
    """Stack all cubes.

    Description: four (two to six) 3 cm cubes lie on the surface; in the paper's closed-loop task two of 5 cm.
    Randomisation: the cubes' positions and yaws; open-loop at least 4.2 cm between any two, closed-loop at
    least 2.4 sides apart and yaws within 45 degrees.
    Success: the cubes form one stack; the gripper is empty and nothing moves.
    Expert: repeat until solved: grasp a cube, lift, move above the highest stack, lower, open.
    Everything else is as in :class:`Stack`.
    """

    kinds = {"cube": cube}  # noqa: RUF012
    spread = math.pi / 4.0


def _check_height(config: EnvConfig) -> None:
    """Check that the gripper can move the last block above all others.

    :raises ParameterError: it cannot
    """
    side, top = CUBE_SIZE * max(config.scales), config.workspace[2][1]
    most = int((top - PASSING) / side + 0.5)
    if most < 2:
        takes = f"one high enough to put one block of {side:.3f} m on another"
        raise ParameterError.of("workspace", config.workspace, takes)
    if config.num_objects > most:
        takes = f"at most {most} blocks of {side:.3f} m in a workspace {top:.3f} m high"
        raise ParameterError.of("num_objects", config.num_objects, takes)
