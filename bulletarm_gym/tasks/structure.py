"""Base class of tasks that build a structure of blocks from its layers."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.blueprint import BUILD_TOLERANCE, Blocks, Blueprint
from bulletarm_gym.experts.builder import Builder
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import UPRIGHT, success_at_rest, upright
from bulletarm_gym.scene.sampling import place_apart, sample_until
from bulletarm_gym.simulation import BodySpec
from bulletarm_gym.tasks.task import Task

SCALE = 0.6
"""Scale of cubes of 3 cm (paper, Detail Description of Environments)."""
BLOCK_SPACING = 0.042
"""Smallest gap (m) between blocks at the start: 2.4 cube sides between two cubes' centres, so that the open
fingers fit."""


def structure_defaults(blocks: int, max_steps: int = 10, allowed: tuple[int, ...] = ()) -> TaskDefaults:
    """Return the defaults of a structure; closed-loop control has ten times the steps.

    :param blocks: number of blocks
    :param max_steps: number of open-loop steps
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
    on level ground. A block over two or more is less than a cube's side from their middle. A long block is
    also within pi/7 of their line and tilted by less than 20 degrees. The gripper is empty and nothing moves.
    Validity: no triangle and no roof (:attr:`upright`) has fallen over, because the gripper cannot right it.
    Expert: add the next block, from the surface up. Blocks that obstruct the structure are put aside first.

    :param config: the environment's parameters
    """

    controls = (OPEN_LOOP, CLOSE_LOOP)
    kinds: ClassVar[Mapping[str, Callable[[str, float], BodySpec]]]
    """Functions that make each kind of block from a name and a scale."""
    upright: Sequence[str] = ()
    """Kinds whose z axis must stay vertical."""
    layers: Sequence[Sequence[str]]
    """The kinds of the blocks of each layer, from the surface up, see :class:`Blueprint`."""
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
        """Return the blocks of all layers, numbered if there are several of a kind."""
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
        return scaled(config, name, self.kinds[kind])

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the blocks apart, without a part of the structure and with space to build it."""

        def place() -> Builder:
            place_apart(scene, rng, scene.objects, BLOCK_SPACING)
            return self.builder(scene, rng)

        sample_until(place, lambda builder: builder.is_unbuilt)

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the blocks on level ground as the finished structure."""
        self.builder(scene, rng).finish()

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the structure is built, the gripper is empty and nothing moves."""
        return success_at_rest(scene, is_built=self.blueprint.is_built(scene, self.blocks(scene)))

    def is_valid(self, scene: Scene) -> bool:
        """Return True if all objects are inside the workspace and no block of :attr:`upright` has fallen."""
        blocks = (block for kind in self.upright for block in self.blocks(scene)[kind])
        return super().is_valid(scene) and not any(_has_fallen(scene, block) for block in blocks)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Add the next block."""
        yield from self.builder(scene, rng).plan()

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
    return ground.inverse().compose(block.pose).tilt >= UPRIGHT
