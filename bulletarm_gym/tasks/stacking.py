"""Stacking blocks, and building houses of fixed blocks and of blocks with random shapes."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.approach import PASSING
from bulletarm_gym.experts.blueprint import BUILD_TOLERANCE, Blocks, Blueprint
from bulletarm_gym.experts.builder import Builder, TowerBuilder
from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.objects import blocks
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.objects.catalogue import create
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, predicates, scaled
from bulletarm_gym.scene.predicates import is_empty, success_at_rest, upright
from bulletarm_gym.scene.sampling import place_apart, sample_until, scatter, stand
from bulletarm_gym.tasks.picking import BORDER_MARGIN
from bulletarm_gym.tasks.task import Task

SCALE = 0.6
"""Scale of cubes of 3 cm (paper, Detail Description of Environments)."""
BLOCK_SPACING = 0.042
"""Smallest gap (m) between blocks at the start: 2.4 cube sides between two cubes' centres, so that the open
fingers fit."""


def structure_defaults(blocks: int, max_steps: int = 10, allowed: tuple[int, ...] = ()) -> TaskDefaults:
    """Return the defaults of a structure; closed-loop control has ten times the steps.

    :param allowed: values of ``num_objects``; by default only ``blocks``
    """
    return TaskDefaults(
        num_objects=blocks,
        max_steps=max_steps,
        object_scale=SCALE,
        allowed_objects=allowed or (blocks,),
        close_loop={"max_steps": 10 * max_steps},
    )


class Structure(Task):
    """A structure of blocks, built by pick and place.

    Description: the structure's blocks lie on the surface.
    Randomisation: positions and yaws of the blocks, at least 4.2 cm between any two.
    Success: every block lies on the blocks below it (see :mod:`~bulletarm_gym.scene.predicates`), the lowest
    touch level ground. A block over two or more is less than a cube's side from their middle. A long block is
    also within pi/7 of their line and tilted by less than 20 degrees. The gripper is empty and nothing moves.
    Validity: no triangle and no roof (:attr:`upright`) has fallen over, because the gripper cannot right it.
    Expert: add the next block, from the surface up. Blocks that obstruct the structure are put aside first.
    """

    controls = (OPEN_LOOP, CLOSE_LOOP)
    upright: Sequence[str] = ("roof", "triangle")
    """Kinds whose z axis must stay vertical."""
    layers: Sequence[Sequence[str]]
    """The kinds of the blocks of each layer, from the surface up, see :class:`Blueprint` and
    :func:`~bulletarm_gym.objects.catalogue.create`."""
    width: ClassVar[float] = CUBE_SIZE
    """Largest width (m) at scale 1 of the blocks on the surface."""

    def __init__(self, config: EnvConfig) -> None:
        super().__init__(config)
        width = self.width * max(config.scales) + 4.0 * BUILD_TOLERANCE
        self.site = (width, 3.0 * width if len(self.layers[0]) > 1 else width)

    @property
    def height(self) -> float:
        """Height (m) of the middle of the top layer."""
        return (len(self.layers) - 0.5) * CUBE_SIZE * max(self.config.scales)

    @cached_property
    def blueprint(self) -> Blueprint:
        """The structure."""
        return Blueprint(self.layers, self.upright, CUBE_SIZE * max(self.config.scales))

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        kinds = [kind for layer in self.layers for kind in layer]
        slots = []
        for place, kind in enumerate(kinds):
            number = kinds[:place].count(kind)
            name = f"{kind} {number}" if kinds.count(kind) > 1 else kind
            slots.append(replace(self.block(config, name, kind, number), kind=kind))
        return slots

    def block(self, config: EnvConfig, name: str, kind: str, number: int) -> ObjectSlot:
        """Return the slot of one block.

        :param number: number of the block within its kind, from 0
        """
        return scaled(config, name, partial(create, kind))

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        def place() -> Builder:
            place_apart(scene, rng, scene.objects, BLOCK_SPACING)
            return self.builder(scene, rng)

        sample_until(place, lambda builder: builder.is_unbuilt)

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        self.builder(scene, rng).finish()

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        return success_at_rest(scene, is_built=self.blueprint.is_built(scene, self.blocks(scene)))

    def is_valid(self, scene: Scene) -> bool:
        blocks = (block for kind in self.upright for block in self.blocks(scene).get(kind, ()))
        return super().is_valid(scene) and not any(_has_fallen(scene, block) for block in blocks)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        yield from self.builder(scene, rng).plan()

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        return max(len(self.builder(scene, rng).placed) - 1, 0), max(len(scene.objects) - 1, 1)

    def builder(self, scene: Scene, rng: np.random.Generator) -> Builder:
        """Return the planner of the structure."""
        return Builder(scene, self.blueprint, self.blocks(scene), rng)

    def blocks(self, scene: Scene) -> Blocks:
        """Return the blocks by kind."""
        found: dict[str, list[SceneObject]] = {}
        for block in scene.objects:
            found.setdefault(block.slot.kind, []).append(block)
        return found


def _has_fallen(scene: Scene, block: SceneObject) -> bool:
    """Return True if a block is not grasped and tilted to the vertical and to the surface."""
    if block is scene.held or upright(block):
        return False
    ground = scene.surface.pose(block.pose.position[:2], 0.0)
    return ground.inverse().compose(block.pose).tilt >= predicates.UPRIGHT


CENTRE_SPACING = 2.4
"""Smallest distance between the blocks' centres, relative to the largest block's side."""
BRICKS = 19
"""Number of sizes of bricks, the number of shapes of blocks."""


class Stack(Structure):
    """A stack of cubes, with a different block on top or without.

    Open-loop control has the arrangement, the success and the expert of
    :class:`~bulletarm_gym.tasks.stacking.Structure`.
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
        if not self._is_close_loop:
            super().arrange(scene, rng)
            return
        side = max(block.spec.extents[0] for block in scene.objects)
        margins = [BORDER_MARGIN * side] * len(scene.objects)
        points = scatter(scene, rng, margins, CENTRE_SPACING * side)
        for block, point in zip(scene.objects, points, strict=True):
            stand(scene, block, point, rng, self.spread)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        if not self._is_close_loop:
            return super().evaluate(scene)
        facts = {"is_stacked": predicates.stacked(scene, scene)}
        if self.top:
            top = self.blocks(scene)[self.top][0]
            facts |= {
                "is_roof_upright": upright(top),
                "is_roof_on_top": predicates.is_top(top, scene.objects),
            }
        return success_at_rest(scene, **facts)

    def builder(self, scene: Scene, rng: np.random.Generator) -> Builder:
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

    instructions = ("Stack {num_objects} cubes{surface}.", "Build a tower of {num_objects} cubes{surface}.")
    spread = math.pi / 4.0

    def goals(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Return the offsets between cubes, and those of a finished stack, (3 n - 2,) m each for n cubes.

        For each cube but the lowest: its position minus that of the cube before it in the order of heights.
        Cubes at the same level are in the order of their numbers. At the end: 0 if the gripper is empty and
        the lowest cube stands on the surface, else a cube's side.
        """
        side = CUBE_SIZE * max(self.config.scales)
        cubes = sorted(scene.objects, key=lambda block: math.floor(block.pose.z / side))
        offsets = np.diff([block.pose.position for block in cubes], axis=0)
        rises = [(a.spec.extents[2] + b.spec.extents[2]) / 2.0 for a, b in pairwise(cubes)]
        desired = [value for rise in rises for value in (0.0, 0.0, rise)]
        is_free = is_empty(scene) and predicates.on_surface(scene, cubes[0])
        return np.append(offsets, 0.0 if is_free else side), np.array([*desired, 0.0])

    def goal_error(self, achieved: FloatArray, desired: FloatArray) -> FloatArray:
        """Return the largest differences of an offset, relative to half a cube's side."""
        half = CUBE_SIZE * max(self.config.scales) / 2.0
        return np.asarray(np.abs(achieved - desired).max(axis=-1) / half)


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

    instructions = (
        "Stack {num_objects} blocks{surface}, with the triangle on top.",
        "Build a tower of {num_objects} blocks{surface}, with the triangle at its top.",
    )
    top = "triangle"
    spread = math.pi / 2.0


class HouseBuilding2(Structure):
    """Put two cubes side by side, and the roof on both.

    Description: two 3 cm cubes and a roof, 12 x 3 x 3 cm, lie on the surface.
    Everything else is as in :class:`~bulletarm_gym.tasks.stacking.Structure`.
    """

    instructions = (
        "Put two cubes side by side{surface}, and the roof on both.",
        "Put the roof on two cubes{surface}.",
    )
    defaults = structure_defaults(3)
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("roof",))


class HouseBuilding3(HouseBuilding2):
    """Put two cubes side by side, the brick on both, and the roof on the brick.

    Description: two 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the surface.
    Everything else is as in :class:`~bulletarm_gym.tasks.stacking.Structure`.
    """

    instructions = (
        "Put two cubes side by side{surface}, the brick on both, and the roof on the brick.",
        "Build a house of two cubes, a brick and a roof{surface}.",
    )
    defaults = structure_defaults(4)
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("brick",), ("roof",))


class HouseBuilding4(HouseBuilding3):
    """Put two cubes side by side, the brick on both, two more cubes on the brick, and the roof on those.

    Description: four 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the surface.
    Everything else is as in :class:`~bulletarm_gym.tasks.stacking.Structure`.
    """

    instructions = (
        "Put two cubes side by side{surface}, the brick on both, two cubes on it, and the roof on those.",
        "Build a house of two floors of cubes, with a brick between them and a roof{surface}.",
    )
    defaults = structure_defaults(6, max_steps=20)
    layers = (("cube", "cube"), ("brick",), ("cube", "cube"), ("roof",))


class ImproviseHouseBuilding2(Structure):
    """Put two blocks of random shapes side by side, and the roof on both.

    Description: two of 19 blocks of one layer, 3.6 to 8 cm wide and long, and a roof, 12 x 3 x 3 cm, lie on
    the surface.
    Randomisation: the shapes and sizes of the blocks; positions and yaws, at least 4.2 cm between any two.
    Everything else is as in :class:`~bulletarm_gym.tasks.stacking.Structure`.
    """

    instructions = (
        "Put two blocks of different shapes side by side{surface}, and the roof on both.",
        "Put the roof on the other two blocks{surface}.",
    )
    defaults = structure_defaults(3)
    layers: Sequence[Sequence[str]] = (("block", "block"), ("roof",))
    width = blocks.CELL * blocks.MAX_STRETCHED_CELLS

    def block(self, config: EnvConfig, name: str, kind: str, number: int) -> ObjectSlot:
        if kind == "roof":
            return super().block(config, name, kind, number)
        specs = (
            blocks.improvise_blocks(name, scale, number)
            if kind == "block"
            else blocks.improvise_bricks(name, scale, BRICKS)
            for scale in config.scales
        )
        variants = tuple(spec for variants in specs for spec in variants)
        scales = np.repeat(config.scales, len(variants) // len(config.scales)).tolist()
        return ObjectSlot(name, variants, scales=tuple(scales))


class ImproviseHouseBuilding3(ImproviseHouseBuilding2):
    """Put two blocks of random shapes side by side, a brick of random size on both, and the roof on it.

    Description: two of 19 blocks of one layer, 3.6 to 8 cm wide and long, a brick 2.5 to 3.5 cm wide, 10 to
    14 cm long and 2 to 3.5 cm high, and a roof, 12 x 3 x 3 cm, lie on the surface.
    Everything else is as in :class:`ImproviseHouseBuilding2`.
    """

    instructions = (
        "Put two blocks of different shapes side by side{surface}, the brick on both, and the roof on it.",
        "Build a house of two blocks, a brick and a roof{surface}.",
    )
    defaults = structure_defaults(4)
    layers = (("block", "block"), ("brick",), ("roof",))
