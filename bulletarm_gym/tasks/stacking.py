"""Stacking blocks, and building houses of fixed blocks and of blocks with random shapes."""

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig
from bulletarm_gym.experts.approach import PASSING
from bulletarm_gym.experts.builder import Builder, TowerBuilder
from bulletarm_gym.objects.blocks import (
    CELL,
    MAX_STRETCHED_CELLS,
    brick,
    cube,
    improvise_blocks,
    improvise_bricks,
    roof,
    triangle,
)
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.scene.predicates import is_top, stacked, success_at_rest, upright
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks.picking import BORDER_MARGIN
from bulletarm_gym.tasks.structure import Structure, structure_defaults

CENTRE_SPACING = 2.4
"""Smallest distance between the blocks' centres, relative to the largest block's side."""
BRICKS = 19
"""Number of sizes of bricks, the number of shapes of blocks."""


class Stack(Structure):
    """A stack of cubes, with a different block on top or without.

    Open-loop control has the arrangement, the success and the expert of
    :class:`~bulletarm_gym.tasks.structure.Structure`.

    :param config: the environment's parameters
    """

    defaults = structure_defaults(4, allowed=(2, 3, 4, 5, 6))
    spread: ClassVar[float]
    """Largest absolute yaw (rad) of a block at the start under closed-loop control."""
    top: ClassVar[str] = ""
    """Kind of the block on the cubes; empty without one."""

    def __init__(self, config: EnvConfig) -> None:
        self._is_close_loop = config.control == CLOSE_LOOP
        tops = [(self.top,)] if self.top else []
        self.layers = [("cube",)] * (config.num_objects - len(tops)) + tops
        if self._is_close_loop:
            self.upright = ()  # an invalid scene would end the episode
        super().__init__(config)

    @property
    def height(self) -> float:
        """Height (m) of the middle of the last block as it passes above all others."""
        return super().height + PASSING

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


class HouseBuilding1(Stack):
    """Stack the cubes, and put the triangle on top.

    Description: three (one to five) 3 cm cubes and a triangle, 3 x 3 x 3 cm, lie on the surface; in the
    paper's closed-loop House Building a cube of 5 cm and a triangle of the same size.
    Randomisation: the blocks' positions and yaws; open-loop at least 4.2 cm between any two, closed-loop at
    least 2.4 sides apart and yaws within 90 degrees.
    Success: the cubes form a stack with the upright triangle on top; the gripper is empty and nothing moves.
    Expert: repeat until solved: grasp the next block (the triangle last), lift, move above the highest stack,
    lower, open.
    Everything else is as in :class:`Stack`.
    """

    kinds = {"cube": cube, "triangle": triangle}  # noqa: RUF012
    upright = ("triangle",)
    top = "triangle"
    spread = math.pi / 2.0


class HouseBuilding2(Structure):
    """Put two cubes side by side, and the roof on both.

    Description: two 3 cm cubes and a roof, 12 x 3 x 3 cm, lie on the surface.
    Everything else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = structure_defaults(3)
    kinds = {"cube": cube, "roof": roof}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("roof",))
    upright = ("roof",)


class HouseBuilding3(HouseBuilding2):
    """Put two cubes side by side, the brick on both, and the roof on the brick.

    Description: two 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the surface.
    Everything else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = structure_defaults(4)
    kinds = {**HouseBuilding2.kinds, "brick": brick}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("brick",), ("roof",))


class HouseBuilding4(HouseBuilding3):
    """Put two cubes side by side, the brick on both, two more cubes on the brick, and the roof on those.

    Description: four 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the surface.
    Everything else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = structure_defaults(6, max_steps=20)
    layers = (("cube", "cube"), ("brick",), ("cube", "cube"), ("roof",))


class ImproviseHouseBuilding2(Structure):
    """Put two blocks of random shapes side by side, and the roof on both.

    Description: two of 19 blocks of one layer, 3.6 to 9 cm wide and long, and a roof, 12 x 3 x 3 cm, lie on
    the surface.
    Randomisation: the shapes and sizes of the blocks; positions and yaws, at least 4.2 cm between any two.
    Everything else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = structure_defaults(3)
    kinds = {"roof": roof}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("block", "block"), ("roof",))
    upright = ("roof",)
    width = CELL * MAX_STRETCHED_CELLS

    def block(self, config: EnvConfig, name: str, kind: str, number: int) -> ObjectSlot:
        """Return the slot of a block with variants of all shapes and sizes."""
        if kind == "roof":
            return super().block(config, name, kind, number)
        specs = (
            improvise_blocks(name, scale, number)
            if kind == "block"
            else improvise_bricks(name, scale, BRICKS)
            for scale in config.scales
        )
        return ObjectSlot(name, tuple(spec for variants in specs for spec in variants))


class ImproviseHouseBuilding3(ImproviseHouseBuilding2):
    """Put two blocks of random shapes side by side, a brick of random size on both, and the roof on it.

    Description: two of 19 blocks of one layer, 3.6 to 9 cm wide and long, a brick 2.5 to 3.5 cm wide, 10 to
    14 cm long and 2 to 3.5 cm high, and a roof, 12 x 3 x 3 cm, lie on the surface.
    Everything else is as in :class:`ImproviseHouseBuilding2`.
    """

    defaults = structure_defaults(4)
    layers = (("block", "block"), ("brick",), ("roof",))
