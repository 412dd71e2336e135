"""Tasks that ask for a structure of blocks: its layers say all, or nearly so."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig
from bulletarm_gym.experts.blueprint import Blocks, Blueprint
from bulletarm_gym.experts.structures import BUILD_TOLERANCE, Builder
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import UPRIGHT, at_rest, is_empty, upright
from bulletarm_gym.scene.sampling import place_apart, sample_until
from bulletarm_gym.simulation import BodySpec
from bulletarm_gym.tasks.task import Task

SCALE = 0.6
"""Makes cubes of 3 cm (paper, Detail Description of Environments)."""
BLOCK_SPACING = 0.042
"""Least distance (m) of blocks at the start: 2.4 cube sides between two cubes' centres, so that open fingers
fit between them."""


@dataclass(frozen=True)
class Part:
    """One of a structure's blocks.

    :param kind: of block
    :param number: among those of its kind, from 0
    :param name: of its role
    """

    kind: str
    number: int
    name: str


class Structure(Task):
    """A structure of blocks, built by pick and place.

    Description: its blocks lie on the ground.
    Randomisation: their positions and yaws, at least 4.2 cm between any two.
    Success: every block lies on those below it (see :mod:`~bulletarm_gym.scene.predicates`), the lowest on
    level ground; one over two or more is less than a cube's side from their middle, a long one besides
    within pi/7 of their line, tilted by less than 20 degrees; the gripper is empty and nothing moves.
    Validity: no triangle and no roof (:attr:`upright`) has fallen over; the gripper cannot right it.
    Expert: add the next block, from the ground up; what lies in the way is put aside first.

    :param config: the environment's parameters
    """

    controls = (OPEN_LOOP, CLOSE_LOOP)
    kinds: ClassVar[Mapping[str, Callable[[str, float], BodySpec]]]
    """How each kind of block is made, from a name and a scale."""
    upright: ClassVar[Sequence[str]] = ()
    """Kinds that must stay as they were made to stand."""
    layers: Sequence[Sequence[str]]
    """The kinds of the blocks of each layer, from the ground up, see :class:`Blueprint`."""

    width: ClassVar[float] = CUBE_SIZE
    """Greatest width (m) at scale 1 of the blocks on the ground."""

    def __init__(self, config: EnvConfig) -> None:
        super().__init__(config)
        width = self.width * max(config.scales) + 4.0 * BUILD_TOLERANCE
        self.site = (width, 3.0 * width if len(self.layers[0]) > 1 else width)

    @property
    def height(self) -> float:
        """Up to the middle of the uppermost block."""
        return (len(self.layers) - 0.5) * CUBE_SIZE * max(self.config.scales)

    @cached_property
    def blueprint(self) -> Blueprint:
        """The structure."""
        return Blueprint(self.layers, self.upright, CUBE_SIZE * max(self.config.scales))

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the blocks of all layers."""
        return [replace(self.block(config, part), kind=part.kind) for part in self._parts]

    def block(self, config: EnvConfig, part: Part) -> ObjectSlot:
        """Return the role of one of the blocks."""
        return scaled(config, part.name, self.kinds[part.kind])

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Lay the blocks apart, no two as if to be built on, and leave room to build."""

        def lay() -> Builder:
            place_apart(scene, rng, scene.objects, BLOCK_SPACING)
            return self._builder(scene, rng)

        sample_until(lay, lambda builder: builder.is_fresh)

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        """Lay the blocks on level ground as the structure they become."""
        self._builder(scene, rng).finish()

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the structure stands, and whether all is done."""
        facts = {
            "is_built": self.blueprint.is_built(scene, self.blocks(scene)),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace and nothing has fallen over that must stand."""
        standing = (item for kind in self.upright for item in self.blocks(scene)[kind])
        return super().is_valid(scene) and not any(_fallen(scene, item) for item in standing)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Add the next block."""
        yield from self._builder(scene, rng).plan()

    def _builder(self, scene: Scene, rng: np.random.Generator) -> Builder:
        return Builder(scene, self.blueprint, self.blocks(scene), rng)

    def blocks(self, scene: Scene) -> Blocks:
        """Return the blocks by kind."""
        found: dict[str, list[SceneObject]] = {}
        for item in scene.objects:
            found.setdefault(item.slot.kind, []).append(item)
        return found

    @cached_property
    def _parts(self) -> list[Part]:
        """Every block; names of those of a kind are numbered if there are several."""
        kinds = [kind for layer in self.layers for kind in layer]
        numbers = [kinds[:place].count(kind) for place, kind in enumerate(kinds)]
        return [
            Part(kind, number, f"{kind} {number}" if kinds.count(kind) > 1 else kind)
            for kind, number in zip(kinds, numbers, strict=True)
        ]


def _fallen(scene: Scene, item: SceneObject) -> bool:
    """Whether an item that is not held stands upright neither by the vertical nor on sloping ground."""
    if item is scene.held or upright(item):
        return False
    ground = scene.surface.pose(item.pose.position[:2], 0.0)
    return ground.inverse().compose(item.pose).tilt >= UPRIGHT
