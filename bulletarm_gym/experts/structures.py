"""Deciding which block goes where next to build a structure: the expert of all tasks with a blueprint."""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from bulletarm_gym.experts.approach import RELEASE, side_yaw
from bulletarm_gym.experts.blueprint import Blocks, Blueprint, Slot, Standing, is_long
from bulletarm_gym.experts.pick_place import (
    SQUARENESS,
    fingers_fit,
    is_box,
    lying_corners,
    palm_fits,
    pick,
    put,
)
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import Footprint, PlacementError, Pose, planar_distance, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import IN_LINE, heading, is_held, middle, rests_on
from bulletarm_gym.scene.sampling import footprint, free_pose, free_site, most_free_point
from bulletarm_gym.surfaces.surface import Point

BASE_GAP = 0.75
"""Gap between blocks side by side, in cube sides ..."""
WIDE_BASE_GAP = 1.5
"""... or, where the fingers need room between them ..."""
MOST_COVERED = 0.9
"""... but the middles of both are under this share of what will lie on them ..."""
TIGHT = 0.005
"""... unless the gap would be less (m)."""
SPAN = 0.45
"""Gap up to which blocks that lie side by side are built on, as a share of what is to lie on them."""
APART = 1.8
"""Distance of blocks side by side on a long one, in cube sides."""
PREFERENCE = 1e-3
"""Room (m) that a metre less of a gap is worth: of places with as much room the nearer one is taken."""
BESIDE_DIRECTIONS = 16
"""In which a block may be put beside another."""
MARGINS = (0.042, 0.02)
"""Gaps (m) kept to other blocks so that fingers fit between them, if need be the smaller one."""
CROWDED = 0.01
"""With less room (m) than that beside what stands another site is looked for."""
BUILD_TOLERANCE = 0.003
"""How far (m) a block may end up from where it was meant to be, and must still be on level ground."""


class Builder:
    """A structure as far as it stands, and what is to be done next.

    :param scene: what is there
    :param blueprint: what it should become
    :param blocks: by kind
    :param rng: draws where things are put aside and where a structure is begun
    """

    def __init__(self, scene: Scene, blueprint: Blueprint, blocks: Blocks, rng: np.random.Generator) -> None:
        self._scene = scene
        self._blueprint = blueprint
        self._blocks = blocks
        self._rng = rng
        self._beside: Pose | None = None

    def plan(self) -> Iterator[Waypoint]:
        """Yield the next pick or place."""
        held = self._scene.held
        if held is None:
            yield pick(self._scene, self._next, self._rng)
        else:
            slot = self._open_slot(held)
            ground = self._aside(held) if slot is None else self._ground(slot, held, self._standing)
            yield put(self._scene, held, [ground])

    def finish(self) -> None:
        """Put every block where it belongs, in an empty scene."""
        blocks = {kind: iter(items) for kind, items in self._blocks.items()}
        cast = {slot: next(blocks[slot.kind]) for slot in self._blueprint.slots}
        size, places = self._base([cast[slot] for slot in self._blueprint.layers[0]])
        spread = math.pi if self._scene.config.random_orientation else 0.0
        site = self._scene.surface.goal_site(size, self._rng, spread)
        standing: Standing = {}
        for slot, item in cast.items():
            if slot.layer == 0:
                ground = site.compose(Pose((0.0, places[slot.place], 0.0)))
            else:
                ground = self._ground(slot, item, standing)
            item.place(ground.compose(_under(item).inverse()))
            standing[slot] = item

    # What stands

    @property
    def is_fresh(self) -> bool:
        """Whether nothing is built that takes more than one block, and there is room to begin."""
        base = self._blueprint.layers[0]
        if len(base) > 1 and any(True for _ in self._ways(len(base))):
            return False
        return bool(self._standing) or self._site(self._spare(base[0])[0]) is not None

    def _ways(self, width: int) -> Iterator[Standing]:
        return self._blueprint.ways(self._scene, self._blocks, width, self._accepts)

    @cached_property
    def _standing(self) -> Standing:
        """The greatest part of the structure that stands and can be gone on with."""
        base = self._blueprint.layers[0]
        for width in range(len(base), 0, -1):
            ways = self._ways(width)
            if width == len(base):
                best = max(ways, key=lambda way: (len(way), self._is_free(way)), default=None)
            else:
                best = self._extendable(list(ways), base[width])
            if best is not None:
                return best
        return {}

    def _accepts(self, slot: Slot, item: SceneObject, standing: Standing) -> bool:
        """Whether an item is near enough to where it would have been put."""
        if slot.layer > 0:
            ground = self._ground(slot, item, standing)
            return planar_distance(item.pose.position, ground.position) < self._blueprint.side / 2.0
        if slot.place == 0:
            return True
        before = list(standing.values())
        gap = footprint(before[-1]).gap(footprint(item))
        return (
            gap < SPAN * self._length_above(slot)
            and self._is_straight([*before, item])
            and self._carries(footprint(before[0]), footprint(item))
        )

    def _is_straight(self, items: Sequence[SceneObject]) -> bool:
        a, b, c = items[0], items[-2], items[-1]
        return a is b or abs(wrap_angle(_direction(a, b) - _direction(b, c))) < IN_LINE

    def _is_free(self, standing: Standing) -> bool:
        """Whether nothing lies on what stands that does not belong there."""
        return not any(True for _ in self._strays(standing))

    def _strays(self, standing: Standing) -> Iterator[SceneObject]:
        """Yield what lies on the structure and is not part of it."""
        for item in self._loose(standing):
            if any(rests_on(self._scene, below, item) for below in standing.values()):
                yield item

    def _loose(self, standing: Standing) -> list[SceneObject]:
        there = standing.values()
        return [item for item in self._scene if item not in there and not is_held(self._scene, item)]

    # What is done next

    @property
    def _next(self) -> SceneObject:
        """The block to pick: what lies where it should not, else what is missing, else the last one."""
        stray = next(self._strays(self._standing), None)
        if stray is not None:
            return self._topmost(stray)
        slot = next((slot for slot in self._blueprint.slots if slot not in self._standing), None)
        loose = [] if slot is None else self._spare(slot)
        return self._topmost(loose[0] if loose else list(self._standing.values())[-1])

    def _spare(self, slot: Slot, standing: Standing | None = None) -> list[SceneObject]:
        """Return the blocks that may go to a slot, the one to take first."""
        standing = self._standing if standing is None else standing
        there = list(standing.values())
        if self._scene.held is not None and self._scene.held.slot.kind == slot.kind:
            return [self._scene.held]
        at = middle(there) if there else self._scene.config.centre
        loose = [item for item in self._blocks[slot.kind] if item not in there]
        return sorted(
            loose, key=lambda item: (self._above(item) is not None, planar_distance(item.pose.position, at))
        )

    def _topmost(self, item: SceneObject) -> SceneObject:
        seen = [item]
        while (above := self._above(seen[-1])) is not None and above not in seen:
            seen.append(above)
        return seen[-1]

    def _above(self, item: SceneObject) -> SceneObject | None:
        free = (other for other in self._scene if other is not item and not is_held(self._scene, other))
        return next((other for other in free if rests_on(self._scene, item, other)), None)

    def _open_slot(self, item: SceneObject) -> Slot | None:
        """Return the slot a held item can be put into now."""
        if not self._is_free(self._standing):
            return None
        missing = (slot for slot in self._blueprint.slots if slot not in self._standing)
        open_slots = (slot for slot in missing if self._is_open(slot))
        return next((slot for slot in open_slots if slot.kind == item.slot.kind), None)

    def _is_open(self, slot: Slot) -> bool:
        if slot.layer == 0:
            return slot.place == len(self._standing)
        return all(below in self._standing for below in slot.below)

    # Where to

    def _ground(self, slot: Slot, item: SceneObject, standing: Standing) -> Pose:
        """Return the level frame on which a slot's block is put, its y axis along the structure's line."""
        if slot.layer == 0:
            return self._beside or self._site(item) or self._aside(item)
        below = [standing[other] for other in slot.below]
        line = [standing[other] for other in self._blueprint.line(slot)]
        yaw = _direction(line[0], line[-1]) if line else _heading(below[0])
        row = self._blueprint.layers[slot.layer]
        spread = len(row) if len(below) == 1 and row[0].below == row[-1].below else 1
        offset = (slot.place - (spread - 1) / 2.0) * APART * self._blueprint.side if spread > 1 else 0.0
        x, y = middle(below)
        height = max(self._scene.world.top(other.body) for other in below)
        return Pose.planar(
            x + offset * math.cos(yaw), y + offset * math.sin(yaw), height, yaw - math.pi / 2.0
        )

    def _aside(self, item: SceneObject) -> Pose:
        """Return the frame of a free place on the ground."""
        for margin in MARGINS:
            try:
                return free_pose(self._scene, self._rng, item, margin).compose(_under(item))
            except PlacementError:
                continue
        return self._scene.surface.pose(most_free_point(self._scene, item), 0.0)

    def _site(self, item: SceneObject) -> Pose | None:
        """Return where an item can be put that a base begins with, with room for the others."""
        base = [self._blocks[slot.kind][slot.place] for slot in self._blueprint.layers[0]]
        size, places = self._base(base)
        for margin in MARGINS:
            try:
                site = free_site(self._scene, self._rng, size, margin, [item])
                return site.compose(Pose((0.0, places[0], 0.0)))
            except PlacementError:
                continue
        return None

    def _base(self, items: Sequence[SceneObject]) -> tuple[Point, list[float]]:
        """Return width and length (m) of blocks side by side, and where (m) each of them is along y."""
        lengths = [item.spec.extents[1] for item in items]
        gap = self._gaps(self._blueprint.layers[0][-1], lengths[0] + lengths[-1])[0]
        total = sum(lengths) + gap * (len(items) - 1)
        ends = np.cumsum([length + gap for length in lengths]) - gap
        places = ends - np.array(lengths) / 2.0 - total / 2.0
        width = max(item.spec.extents[0] for item in items)
        return (width + 2.0 * BUILD_TOLERANCE, total + 2.0 * BUILD_TOLERANCE), places.tolist()

    # Beside what stands

    def _extendable(self, ways: Sequence[Standing], slot: Slot) -> Standing | None:
        """Return the base that has most room for its next block, which is remembered; None if none has."""
        found = [(*beside, way) for way in ways for beside in self._places(way, slot)]
        best = sorted(found, key=lambda place: -place[0])
        if not best or (best[0][0] < CROWDED and self._site(self._spare(slot, {})[0]) is not None):
            return None
        roomy = (place for place in best if self._can_be_put(place[1], self._spare(slot, place[2])[0]))
        _, self._beside, way = next(roomy, best[0])
        return way

    def _places(self, way: Standing, slot: Slot) -> Iterator[tuple[float, Pose]]:
        """Yield how much room there is (m), and the frame, for places beside the last block of a base."""
        base = list(way.values())[: slot.place]
        item = self._spare(slot, way)[0]
        if not self._is_free(way):
            return
        others = [footprint(other) for other in self._loose(way) if other is not item]
        covered = [footprint(other) for other in base]
        width, length, _ = lying_corners(item).sides
        x, y = covered[-1].centre
        half = length / 2.0
        for direction in self._directions(base):
            along = np.array([math.cos(direction), math.sin(direction)])
            reach = float(((covered[-1].points - (x, y)) @ along).max())
            for gap in self._gaps(slot, 2.0 * (reach + half)):
                distance = reach + gap + half
                ground = Pose.planar(
                    x + distance * float(along[0]),
                    y + distance * float(along[1]),
                    self._scene.surface.level,
                    direction - math.pi / 2.0,
                )
                base_of = Footprint.rectangle((width, 2.0 * half), ground)
                on_site = self._scene.surface.fits_site(base_of.grown(BUILD_TOLERANCE))
                if on_site and self._carries(covered[0], base_of):
                    room = min((base_of.gap(other) for other in others), default=MARGINS[0])
                    yield min(room, MARGINS[0]) - PREFERENCE * gap, ground

    def _directions(self, base: Sequence[SceneObject]) -> list[float]:
        if len(base) > 1:
            return [_direction(base[0], base[-1])]
        if "r" not in self._scene.config.action_sequence:
            return [math.pi / 2.0, -math.pi / 2.0]
        try:
            first = self._scene.surface.goal_site(self._blueprint_site(), self._rng).yaw + math.pi / 2.0
        except PlacementError:
            first = 0.0
        return [first + 2.0 * math.pi * number / BESIDE_DIRECTIONS for number in range(BESIDE_DIRECTIONS)]

    def _blueprint_site(self) -> tuple[float, float]:
        return (self._blueprint.side, self._blueprint.side)

    def _can_be_put(self, ground: Pose, item: SceneObject) -> bool:
        """Whether the fingers have room to put an item on a frame."""
        corners = lying_corners(item)
        width, length, _ = corners.sides
        hand = ground.compose(Pose((0.0, 0.0, RELEASE - corners.low[2])))
        turns = (0.0, math.pi / 2.0) if is_box(item) and length < SQUARENESS * width else (0.0,)
        if "r" not in self._scene.config.action_sequence:
            turns = (0.0,)
        ways = [hand.compose(Pose.planar(0.0, 0.0, 0.0, turn)) for turn in turns]
        return any(fingers_fit(self._scene, way, item) and palm_fits(self._scene, way, item) for way in ways)

    def _gaps(self, slot: Slot, length: float) -> list[float]:
        """Return the gaps (m) to try beside a slot's block, the best one first.

        :param length: of both blocks together (m)
        """
        most = MOST_COVERED * self._length_above(slot) - length / 2.0
        return [max(TIGHT, min(gap * self._blueprint.side, most)) for gap in (BASE_GAP, WIDE_BASE_GAP)]

    def _length_above(self, slot: Slot) -> float:
        """Return the length (m) of what is to lie on a slot's block and its neighbour."""
        above = (other for other in self._blueprint.slots if slot in other.below and len(other.below) > 1)
        kind = next((other.kind for other in above), None)
        return self._blocks[kind][0].spec.extents[1] if kind else 3.0 * self._blueprint.side

    def _carries(self, first: Footprint, last: Footprint) -> bool:
        """Whether what is to lie on a base would not touch the ground beside it.

        :param first: what the first block of the base covers
        :param last: what the last one does
        """
        surface = self._scene.surface
        (x0, y0), (x1, y1) = first.mean, last.mean
        over = Footprint.rectangle(
            (self._blueprint.side, self._length_above(self._blueprint.layers[0][-1])),
            Pose.planar((x0 + x1) / 2.0, (y0 + y1) / 2.0, 0.0, math.atan2(y1 - y0, x1 - x0) - math.pi / 2.0),
        )
        return float(surface.heights(over.points).max()) < surface.level + 0.8 * self._blueprint.side


def _under(item: SceneObject) -> Pose:
    """Return the frame below the middle of an item, as it was made to stand, in the item's frame."""
    low, high = item.spec.mesh.bounds.tolist()
    return Pose(((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]))


def _direction(first: SceneObject, second: SceneObject) -> float:
    return math.atan2(second.pose.y - first.pose.y, second.pose.x - first.pose.x)


def _heading(item: SceneObject) -> float:
    """Return the direction (rad) of what lies on a block: along it, or along a side of it."""
    return heading(item) if is_long(item) else side_yaw(item.pose) + math.pi / 2.0
