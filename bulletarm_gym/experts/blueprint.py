"""What a structure of blocks looks like, layer by layer: goal, start and expert follow from it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import (
    between,
    carries,
    in_line,
    is_held,
    is_level,
    lies_flat,
    on_site,
    on_top,
    upright,
)

LONG = 1.5
"""A block whose side along y is this many times as long as that along x is long: it is laid along a line."""


@dataclass(frozen=True, eq=False)
class Slot:
    """A place in a structure; each is equal to itself alone.

    :param kind: of the block that belongs there
    :param layer: 0 on the ground
    :param place: in its layer, counted along the structure's line
    :param below: the slots of the blocks it lies on
    """

    kind: str
    layer: int
    place: int
    below: tuple["Slot", ...] = ()


Blocks = Mapping[str, Sequence[SceneObject]]
"""All blocks of a task, by kind."""
Standing = dict[Slot, SceneObject]
"""The blocks that are where they belong, by slot; those below before those above."""
Accept = Callable[[Slot, SceneObject, Standing], bool]


class Blueprint:
    """Layers of blocks from the ground up; those of a layer are side by side along one line.

    A layer of fewer blocks than the one below lies over the gaps between them, one of as many block on block,
    and one of more on a single long block.

    :param layers: the kind of each block, layer by layer
    :param upright: kinds that must stay as they were made to stand
    :param side: of a cube (m)
    :raises ValueError: there is no such layer over the one below
    """

    def __init__(self, layers: Sequence[Sequence[str]], upright: Sequence[str], side: float) -> None:
        self.side = side
        self._upright = upright
        self.layers: list[tuple[Slot, ...]] = []
        for layer in layers:
            self.layers.append(tuple(_slots(layer, len(self.layers), self.layers[-1:])))

    @property
    def slots(self) -> list[Slot]:
        """All slots from the ground up."""
        return [slot for layer in self.layers for slot in layer]

    def line(self, slot: Slot) -> tuple[Slot, ...]:
        """Return the slots whose middle a block lies over, and along whose line if it is long.

        What lies on a single block is measured against the nearest layer below of two blocks or more.
        """
        if len(slot.below) > 1 or len(self.layers[slot.layer]) > 1:
            return slot.below if len(slot.below) > 1 else ()
        return next((layer for layer in reversed(self.layers[: slot.layer]) if len(layer) > 1), ())

    def is_built(self, scene: Scene, blocks: Blocks) -> bool:
        """Whether the structure stands, whichever block of a kind plays which part."""
        everything = len(self.slots)
        ways = self.ways(scene, blocks, len(self.layers[0]))
        return any(len(standing) == everything and self._is_balanced(standing) for standing in ways)

    def ways(
        self,
        scene: Scene,
        blocks: Blocks,
        width: int,
        accept: Accept = lambda slot, item, standing: True,
    ) -> Iterator[Standing]:
        """Yield what stands of the structure on each of the bases there are.

        :param width: number of blocks of the base
        :param accept: says which of the blocks that lie where they may count
        """
        free = {
            kind: [item for item in items if not is_held(scene, item) and lies_flat(item)]
            for kind, items in blocks.items()
        }
        base = self.layers[0][:width]
        ground = {kind: [item for item in free[kind] if on_site(scene, item)] for kind in _kinds(base)}
        for items in permutations([item for some in ground.values() for item in some], width):
            standing: Standing = {}
            for slot, item in zip(base, items, strict=True):
                if item not in ground[slot.kind] or not accept(slot, item, standing):
                    break
                standing[slot] = item
            else:
                yield self._raised(scene, free, standing, accept)

    def _raised(self, scene: Scene, free: Blocks, standing: Standing, accept: Accept) -> Standing:
        """Add to a base what lies on it as it should."""
        for slot in self.slots[len(self.layers[0]) :]:
            fitting = (
                item
                for item in free[slot.kind]
                if item not in standing.values()
                and self._fits(scene, slot, item, standing)
                and accept(slot, item, standing)
            )
            if (item := next(fitting, None)) is not None:
                standing[slot] = item
        return standing

    def _fits(self, scene: Scene, slot: Slot, item: SceneObject, standing: Standing) -> bool:
        """Whether an item lies as a slot's block should."""
        lies_on = on_top if len(slot.below) == 1 else carries
        if not all(below in standing and lies_on(scene, standing[below], item) for below in slot.below):
            return False
        if slot.kind in self._upright and not upright(item):
            return False
        line = [standing[other] for other in self.line(slot)]
        if not line:
            return True
        return between(item, line, self.side) and (
            not is_long(item) or (is_level(item) and in_line(item, line))
        )

    def _is_balanced(self, standing: Standing) -> bool:
        """Whether every block that carries two or more side by side is in their middle."""
        return all(
            between(standing[layer[0].below[0]], [standing[slot] for slot in layer], self.side)
            for layer in self.layers[1:]
            if len(layer) > 1 and len(layer[0].below) == 1 and layer[0].below == layer[-1].below
        )


def is_long(item: SceneObject) -> bool:
    """Whether a block is long enough to be laid along a line."""
    return item.spec.extents[1] > LONG * item.spec.extents[0]


def _kinds(slots: Sequence[Slot]) -> list[str]:
    return list(dict.fromkeys(slot.kind for slot in slots))


def _slots(layer: Sequence[str], number: int, before: Sequence[tuple[Slot, ...]]) -> Iterator[Slot]:
    """Yield a layer's slots over the layer before, if there is one."""
    below = before[0] if before else ()
    overlap = len(below) - len(layer) + 1
    if below and overlap < 1 < len(below):
        raise ValueError(f"layers: got {len(layer)} blocks on {len(below)}, takes as many, fewer, or on one")
    for place, kind in enumerate(layer):
        yield Slot(kind, number, place, below[place : place + overlap] if overlap >= 1 else below)
