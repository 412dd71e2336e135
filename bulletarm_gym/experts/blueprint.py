"""Structures of blocks, described layer by layer."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from bulletarm_gym.scene import Scene, SceneObject, predicates
from bulletarm_gym.surfaces.surface import Point

LONG = 1.5
"""Smallest ratio of the sides along y and x of a long block, which is placed along a line."""
BASE_GAP = 0.75
"""Gap between blocks side by side, relative to a cube's side."""
WIDE_BASE_GAP = 1.5
"""Gap between blocks side by side where the fingers do not fit into :data:`BASE_GAP`."""
MAX_COVERED = 0.9
"""Largest distance between the centres of two blocks, relative to the length of the block above them."""
TIGHT = 0.005
"""Smallest gap (m) between blocks side by side."""
BUILD_TOLERANCE = 0.003
"""Largest error (m) of a block's position, within which it must be on level ground."""


@dataclass(frozen=True, eq=False)
class Position:
    """Position of a block in a structure; two positions are never equal.

    :param kind: kind of the block
    :param layer: number of the layer, 0 on the surface
    :param place: number in the layer, along the structure's line
    :param below: positions of the blocks that support this one
    """

    kind: str
    layer: int
    place: int
    below: tuple["Position", ...] = ()


Blocks = Mapping[str, Sequence[SceneObject]]
"""All blocks of a task, by kind."""
Placed = dict[Position, SceneObject]
"""The blocks that are placed correctly, by position; supporting blocks come first."""
Accept = Callable[[Position, SceneObject, Placed], bool]


class Blueprint:
    """Layers of blocks from the surface up; the blocks of a layer are side by side along one line.

    A layer of fewer blocks than the one below lies over the gaps between them. A layer of the same number of
    blocks lies block on block. A layer of more blocks lies on a single long block.

    :param layers: the kind of each block, layer by layer
    :param upright: kinds whose z axis must stay vertical
    :param side: side length of a cube (m)
    :raises ValueError: a layer has more blocks than the layer below, which is not a single block
    """

    def __init__(self, layers: Sequence[Sequence[str]], upright: Sequence[str], side: float) -> None:
        self.side = side
        self._upright = upright
        self.layers: list[tuple[Position, ...]] = []
        below: tuple[Position, ...] = ()
        for number, layer in enumerate(layers):
            shared = len(below) - len(layer) + 1  # number of blocks that support each block
            if shared < 1 < len(below):
                takes = "have the same number, fewer, or all on one block"
                raise ValueError(f"layers must {takes}, got {len(layer)} on {len(below)}")
            row = [
                Position(kind, number, place, below[place : place + shared] if shared >= 1 else below)
                for place, kind in enumerate(layer)
            ]
            below = tuple(row)
            self.layers.append(below)

    @property
    def positions(self) -> list[Position]:
        """All positions from the surface up."""
        return [position for layer in self.layers for position in layer]

    def line(self, position: Position) -> tuple[Position, ...]:
        """Return the positions whose middle a block lies over, and along whose line if it is long.

        For a block on a single block it is the nearest layer below with two blocks or more.
        """
        if len(position.below) > 1 or len(self.layers[position.layer]) > 1:
            return position.below if len(position.below) > 1 else ()
        return next((layer for layer in reversed(self.layers[: position.layer]) if len(layer) > 1), ())

    def is_built(self, scene: Scene, blocks: Blocks) -> bool:
        """Return True if the structure is complete; blocks of a kind are interchangeable."""
        candidates = self.partial_structures(scene, blocks, len(self.layers[0]))
        return any(len(placed) == len(self.positions) and self._is_balanced(placed) for placed in candidates)

    def partial_structures(
        self,
        scene: Scene,
        blocks: Blocks,
        width: int,
        accept: Accept = lambda position, block, placed: True,
    ) -> Iterator[Placed]:
        """Yield the correctly placed blocks for each possible base.

        :param width: number of blocks of the base
        :param accept: returns False for blocks that do not count
        """
        flat = {kind: filter(predicates.lies_flat, same) for kind, same in blocks.items()}
        free = {kind: [block for block in same if block is not scene.held] for kind, same in flat.items()}
        base = self.layers[0][:width]
        kinds = dict.fromkeys(position.kind for position in base)
        ground = {
            kind: [block for block in free[kind] if predicates.on_ground(scene, block)] for kind in kinds
        }
        for chosen in permutations([block for same in ground.values() for block in same], width):
            placed: Placed = {}
            for position, block in zip(base, chosen, strict=True):
                if block not in ground[position.kind] or not accept(position, block, placed):
                    break
                placed[position] = block
            else:
                yield self._add_layers(scene, free, placed, accept)

    def _add_layers(self, scene: Scene, free: Blocks, placed: Placed, accept: Accept) -> Placed:
        for position in self.positions[len(self.layers[0]) :]:
            fitting = (
                block
                for block in free[position.kind]
                if block not in placed.values()
                and self._fits(scene, position, block, placed)
                and accept(position, block, placed)
            )
            if (block := next(fitting, None)) is not None:
                placed[position] = block
        return placed

    def _fits(self, scene: Scene, position: Position, block: SceneObject, placed: Placed) -> bool:
        lies_on = predicates.on_top if len(position.below) == 1 else predicates.carries
        if not all(below in placed and lies_on(scene, placed[below], block) for below in position.below):
            return False
        if position.kind in self._upright and not predicates.upright(block):
            return False
        line = [placed[other] for other in self.line(position)]
        if not line:
            return True
        return predicates.between(block, line, self.side) and (
            not is_long(block) or predicates.lies_along(block, line)
        )

    def _is_balanced(self, placed: Placed) -> bool:
        """Return True if every block that supports two or more side by side is below their middle."""
        return all(
            predicates.between(placed[layer[0].below[0]], [placed[position] for position in layer], self.side)
            for layer in self.layers[1:]
            if len(layer) > 1 and len(layer[0].below) == 1 and layer[0].below == layer[-1].below
        )

    def length_above(self, position: Position, blocks: Blocks) -> float:
        """Return the length (m) of the block above a position and its neighbour."""
        above = (other for other in self.positions if position in other.below and len(other.below) > 1)
        kind = next((other.kind for other in above), None)
        return blocks[kind][0].spec.extents[1] if kind else 3.0 * self.side

    def gaps(self, position: Position, length: float, blocks: Blocks) -> list[float]:
        """Return the gaps (m) to try next to a position, the best one first.

        :param length: length of both blocks together (m)
        """
        most = MAX_COVERED * self.length_above(position, blocks) - length / 2.0
        return [max(TIGHT, min(gap * self.side, most)) for gap in (BASE_GAP, WIDE_BASE_GAP)]

    def base(self, chosen: Sequence[SceneObject], blocks: Blocks) -> tuple[Point, list[float]]:
        """Return width and length (m) of a base, and the position (m) of each of its blocks along y."""
        lengths = [block.spec.extents[1] for block in chosen]
        gap = self.gaps(self.layers[0][-1], lengths[0] + lengths[-1], blocks)[0]
        total = sum(lengths) + gap * (len(chosen) - 1)
        ends = np.cumsum([length + gap for length in lengths]) - gap
        offsets = ends - np.array(lengths) / 2.0 - total / 2.0
        width = max(block.spec.extents[0] for block in chosen)
        return (width + 2.0 * BUILD_TOLERANCE, total + 2.0 * BUILD_TOLERANCE), offsets.tolist()


def is_long(block: SceneObject) -> bool:
    """Return True if a block is placed along a line."""
    return block.spec.extents[1] > LONG * block.spec.extents[0]
