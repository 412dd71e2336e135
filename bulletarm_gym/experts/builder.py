"""Planning of the next block of a structure: the expert of all tasks with a blueprint."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, cached_property, partial

import numpy as np

from bulletarm_gym.experts import Waypoint, pick_place
from bulletarm_gym.experts.approach import RELEASE, grasp_object, place_object, rotates, side_yaw
from bulletarm_gym.experts.blueprint import BUILD_TOLERANCE, Blocks, Blueprint, Placed, Position, is_long
from bulletarm_gym.geometry import Footprint, PlacementError, Pose, planar_distance, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject, predicates, sampling
from bulletarm_gym.scene.predicates import direction
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.surfaces.surface import Point

SPAN = 0.45
"""Largest gap between blocks that are built on, relative to the length of the block above them."""
APART = 1.8
"""Distance between the centres of blocks side by side on a long block, relative to a cube's side."""
PREFERENCE = 1e-3
"""Free distance (m) that compensates for one metre of gap in the choice of a position."""
DIRECTIONS = 16
"""Number of directions in which a block can be placed next to another."""
MARGINS = (0.042, 0.02)
"""Gaps (m) to other blocks with space for the fingers; the second is used if the first is impossible."""
CROWDED = 0.01
"""Free distance (m) around the next block of a base below which another base is started."""


class Builder:
    """Correctly placed blocks of a structure, and the next pick or place.

    :param scene: scene with the blocks
    :param blueprint: structure to build
    :param blocks: blocks by kind
    :param rng: samples positions of blocks that are put aside and of the structure
    """

    def __init__(self, scene: Scene, blueprint: Blueprint, blocks: Blocks, rng: np.random.Generator) -> None:
        self._scene = scene
        self._held = scene.held
        self._blueprint = blueprint
        self._blocks = blocks
        self._rng = rng
        self._next_base: Pose | None = None
        self._on_site = cache(partial(predicates.on_site, scene))

    def plan(self) -> Iterator[Waypoint]:
        """Yield the next pick or place."""
        if self._held is None:
            yield pick_place.pick(self._scene, self._next, self._rng)
            return
        position = self._open_position
        frame = self._aside(self._held) if position is None else self._support(position, self.placed)
        yield pick_place.put(self._scene, self._held, frame)

    def finish(self) -> None:
        """Place every block at its final pose, in an empty scene."""
        size, offsets = self._base
        site = sampling.goal_site(self._scene, self._rng, size)
        placed: Placed = {}
        for position, block in self._chosen.items():
            if position.layer == 0:
                frame = site.compose(Pose((0.0, offsets[position.place], 0.0)))
            else:
                frame = self._support(position, placed)
            block.place(frame.compose(_bottom(block).inverse()))
            placed[position] = block

    @cached_property
    def _chosen(self) -> Placed:
        """A block for each position."""
        blocks = {kind: iter(same) for kind, same in self._blocks.items()}
        return {position: next(blocks[position.kind]) for position in self._blueprint.positions}

    @property
    def _base(self) -> tuple[Point, list[float]]:
        base = [self._chosen[one] for one in self._blueprint.layers[0]]
        (width, length), offsets = self._blueprint.base(base, self._blocks)
        return (width, max(length, self._inside_length)), offsets

    @cached_property
    def _inside_length(self) -> float:
        """Length (m) that must be in the workspace: that of the longest block, or 0 if only centres must."""
        if self._scene.config.workspace_check == "point":
            return 0.0
        return max(block.spec.extents[1] for block in self._chosen.values()) + 2.0 * BUILD_TOLERANCE

    @property
    def is_unbuilt(self) -> bool:
        """Whether no part of more than one block is built, and a structure can be started."""
        base = self._blueprint.layers[0]
        if len(base) > 1 and any(True for _ in self._candidates(len(base))):
            return False
        return bool(self.placed) or self._site(self._spare(base[0], {})[0]) is not None

    # Placed blocks

    def _candidates(self, width: int) -> Iterator[Placed]:
        return self._blueprint.partial_structures(self._scene, self._blocks, width, self._accepts)

    @cached_property
    def placed(self) -> Placed:
        """The largest part of the structure that can be extended."""
        base = self._blueprint.layers[0]
        complete = self._candidates(len(base))
        best = max(complete, key=lambda placed: (len(placed), self._misplaced(placed) is None), default=None)
        for width in range(len(base) - 1, 0, -1):
            best = best or self._extendable(list(self._candidates(width)), base[width])
        return best or {}

    def _accepts(self, position: Position, block: SceneObject, placed: Placed) -> bool:
        """Return True if a block is close to the pose that the expert plans."""
        if position.layer > 0:
            frame = self._support(position, placed)
            return planar_distance(block.pose.position, frame.position) < self._blueprint.side / 2.0
        if not self._on_site(block):
            return False
        if position.place == 0:
            return True
        before = list(placed.values())
        first, last = before[0], before[-1]
        angle = 0.0 if first is last else wrap_angle(direction(first, last) - direction(last, block))
        length = self._blueprint.length_above(position, self._blocks)
        return (
            footprint(last).gap(footprint(block)) < SPAN * length
            and abs(angle) < predicates.IN_LINE
            and self._supports(footprint(first), footprint(block))
        )

    def _misplaced(self, placed: Placed) -> SceneObject | None:
        """Return a block that lies on the placed blocks and does not belong there."""
        on_them = (obj for obj in self._loose(placed) if any(self._lies_on(b, obj) for b in placed.values()))
        return next(on_them, None)

    def _loose(self, placed: Placed) -> list[SceneObject]:
        return [obj for obj in self._scene if obj not in placed.values() and obj is not self._held]

    # Next block

    @property
    def _next(self) -> SceneObject:
        """The block to pick: a misplaced block, else one for the next open position, else the last one."""
        block = self._misplaced(self.placed)
        if block is None:
            position = next((p for p in self._blueprint.positions if p not in self.placed), None)
            spare = [] if position is None else self._spare(position, self.placed)
            block = spare[0] if spare else list(self.placed.values())[-1]
        seen = [block]
        while (above := self._above(seen[-1])) is not None and above not in seen:
            seen.append(above)
        return seen[-1]

    def _spare(self, position: Position, placed: Placed) -> list[SceneObject]:
        """Return the blocks that can be placed at a position, the best one first."""
        if self._held is not None and self._held.slot.kind == position.kind:
            return [self._held]
        there = list(placed.values())
        loose = [block for block in self._blocks[position.kind] if block not in there]
        return sorted(loose, key=lambda block: self._preference(block, there))

    def _preference(self, block: SceneObject, there: Sequence[SceneObject]) -> tuple[float, ...]:
        """Return the sort key of a block: blocks below others last, then by the distance to the structure."""
        centre = predicates.middle(there) if there else self._scene.config.centre
        return (self._above(block) is not None, planar_distance(block.pose.position, centre))

    def _above(self, block: SceneObject) -> SceneObject | None:
        free = (other for other in self._scene if other is not block and other is not self._held)
        return next((other for other in free if self._lies_on(block, other)), None)

    def _lies_on(self, bottom: SceneObject, top: SceneObject) -> bool:
        return predicates.rests_on(self._scene, bottom, top)

    @property
    def _open_position(self) -> Position | None:
        """Position at which the grasped block can be placed now."""
        assert self._held is not None
        if self._misplaced(self.placed) is not None:
            return None
        for position in self._blueprint.positions:
            supported = all(below in self.placed for below in position.below)
            is_open = supported if position.layer else position.place == len(self.placed)
            if position.kind == self._held.slot.kind and is_open and position not in self.placed:
                return position
        return None

    # Target frames

    def _support(self, position: Position, placed: Placed) -> Pose:
        """Return the level frame on which a block is placed, its y axis along the structure's line."""
        if position.layer == 0:
            assert self._held is not None
            return self._next_base or self._site(self._held) or self._aside(self._held)
        below = [placed[other] for other in position.below]
        line = [placed[other] for other in self._blueprint.line(position)]
        yaw = direction(line[0], line[-1]) if line else _long_axis(below[0])
        row = self._blueprint.layers[position.layer]
        count = len(row) if len(below) == 1 and row[0].below == row[-1].below else 1
        offset = (position.place - (count - 1) / 2.0) * APART * self._blueprint.side if count > 1 else 0.0
        x, y = predicates.middle(below)
        height = max(self._scene.world.top(other.body) for other in below)
        return Pose.planar(
            x + offset * math.cos(yaw), y + offset * math.sin(yaw), height, yaw - math.pi / 2.0
        )

    def _aside(self, block: SceneObject) -> Pose:
        """Return the frame of a free place on the surface."""
        pose = _sample(lambda margin: sampling.free_pose(self._scene, self._rng, block, margin))
        if pose is None:
            return self._scene.surface.pose(sampling.most_free_point(self._scene, block), 0.0)
        return pose.compose(_bottom(block))

    def _site(self, block: SceneObject) -> Pose | None:
        """Return the frame of the first block of a base, with space for the other blocks."""
        size, offsets = self._base
        site = _sample(lambda margin: sampling.free_site(self._scene, self._rng, size, margin, [block]))
        return None if site is None else site.compose(Pose((0.0, offsets[0], 0.0)))

    # Next block of a base

    def _extendable(self, candidates: Sequence[Placed], position: Position) -> Placed | None:
        """Return the base with most space for its next block, whose frame is kept; None if none has."""
        found = [(*option, placed) for placed in candidates for option in self._options(placed, position)]
        ordered = sorted(found, key=lambda option: -option[0])
        # The first options usually pass, so the slower checks of the others are not needed.
        possible = (one for one in ordered if self._is_possible(*one[2:]))
        best = next(possible, None)
        if best is None or (best[0] < CROWDED and self._site(self._spare(position, {})[0]) is not None):
            return None
        checked = itertools.chain([best], possible)
        fitting = (one for one in checked if self._can_put(one[1], self._spare(position, one[3])[0]))
        _, self._next_base, _, placed = next(fitting, best)
        return placed

    def _options(self, placed: Placed, position: Position) -> Iterator[tuple[float, Pose, Footprint]]:
        """Yield the free distance (m), the frame and the area of places next to the last block of a base."""
        base = list(placed.values())[: position.place]
        block = self._spare(position, placed)[0]
        if self._misplaced(placed) is not None:
            return
        others = [footprint(other) for other in self._loose(placed) if other is not block]
        last, centre = footprint(base[-1]), footprint(base[-1]).centre
        width, length, _ = pick_place.resting_box(block).sides
        half = length / 2.0
        for heading in self._headings(base):
            along = np.array([math.cos(heading), math.sin(heading)])
            reach = float(((last.points - centre) @ along).max())
            for gap in self._blueprint.gaps(position, 2.0 * (reach + half), self._blocks):
                x, y = (float(value) for value in centre + (reach + gap + half) * along)
                frame = Pose.planar(x, y, self._scene.surface.level, heading - math.pi / 2.0)
                area = Footprint.rectangle((width, 2.0 * half), frame)
                yield min(area.gap(*others), MARGINS[0]) - PREFERENCE * gap, frame, area

    def _is_possible(self, area: Footprint, placed: Placed) -> bool:
        """Return True if an area is on the site and the block over it and a base's first block has space."""
        first = footprint(next(iter(placed.values())))
        on_site = self._scene.surface.fits_site(area.grown(BUILD_TOLERANCE))
        return on_site and self._supports(first, area)

    def _headings(self, base: Sequence[SceneObject]) -> list[float]:
        """Return the directions (rad) from the last block of a base to its next block."""
        if len(base) > 1:
            return [direction(base[0], base[-1])]
        if not rotates(self._scene):
            return [math.pi / 2.0, -math.pi / 2.0]
        side = self._blueprint.side
        first = 0.0
        with suppress(PlacementError):
            first = self._scene.surface.goal_site((side, side), self._rng).yaw + math.pi / 2.0
        return [first + 2.0 * math.pi * number / DIRECTIONS for number in range(DIRECTIONS)]

    def _can_put(self, frame: Pose, block: SceneObject) -> bool:
        """Return True if the gripper collides with nothing when it places a block on a frame."""
        box = pick_place.resting_box(block)
        width, length, _ = box.sides
        tool = frame.compose(Pose((0.0, 0.0, RELEASE - box.bottom)))
        is_square = pick_place.is_box(block) and length < pick_place.SQUARENESS * width
        for yaw in (0.0, math.pi / 2.0) if is_square and rotates(self._scene) else (0.0,):
            pose = tool.compose(Pose.planar(0.0, 0.0, 0.0, yaw))
            if all(fit(self._scene, pose, block) for fit in (pick_place.fingers_fit, pick_place.palm_fits)):
                return True
        return False

    def _supports(self, first: Footprint, last: Footprint) -> bool:
        """Return True if the block above the first and last block of a base clears surface and border."""
        surface, side = self._scene.surface, self._blueprint.side
        length = self._blueprint.length_above(self._blueprint.layers[0][-1], self._blocks)
        (x0, y0), (x1, y1) = (one.points.mean(axis=0).tolist() for one in (first, last))
        yaw = math.atan2(y1 - y0, x1 - x0) - math.pi / 2.0
        frame = Pose.planar((x0 + x1) / 2.0, (y0 + y1) / 2.0, 0.0, yaw)
        over = Footprint.rectangle((side, length), frame)
        clears = float(surface.heights(over.points).max()) < surface.level + 0.8 * side
        inside = self._inside_length
        return clears and (
            not inside or Footprint.rectangle((side, inside), frame).is_inside(surface.workspace)
        )


class TowerBuilder(Builder):
    """Builder of a tower of cubes, with a different block on top or without, by closed-loop waypoints.

    The cube nearest to the gripper is grasped next. While a cube is grasped, the nearest tower is extended.
    The plan is therefore visible and does not change while the gripper moves.
    """

    def plan(self) -> Iterator[Waypoint]:
        """Yield the waypoints of the next block."""
        scene, held = self._scene, self._held
        if held is None:
            block = self._next
            symmetry = math.pi / 2.0 if block in self._cubes else math.pi
            yield from grasp_object(scene, block, self._yaw(block), symmetry)
        elif self.placed and self._open_position is not None:
            below = list(self.placed.values())[-1]
            rotation = wrap_angle(self._yaw(below) - self._yaw(held), math.pi / 2.0)
            height = scene.world.top(below.body) + RELEASE
            yield from place_object(scene, held, below.pose.position, height, rotation)
        else:
            spot = sampling.most_free_point(scene, held)
            yield from place_object(scene, held, spot, scene.surface.height(spot) + RELEASE)

    @cached_property
    def placed(self) -> Placed:
        """The highest tower; of equal ones the nearest while a block is grasped, else the most distant."""
        nearest_first = sorted(self._cubes, key=self._distance)
        bases = nearest_first if self._held is not None else reversed(nearest_first)
        towers = (self._tower(cube) for cube in bases if cube is not self._held)
        best = max(towers, key=lambda tower: (len(tower), self._leaves_space(tower)), default=[])
        return dict(zip(self._blueprint.positions, best, strict=False))

    @property
    def _cubes(self) -> Sequence[SceneObject]:
        return self._blocks[self._blueprint.positions[0].kind]

    def _tower(self, base: SceneObject) -> list[SceneObject]:
        """Return a cube and, if it is on the surface, the cubes on it."""
        tower = [base]
        above = self._above(base) if predicates.on_surface(self._scene, base) else None
        while above is not None and above in self._cubes:
            tower.append(above)
            above = self._above(above)
        return tower

    def _leaves_space(self, tower: Sequence[SceneObject]) -> bool:
        """Return True if the block on top can be grasped next to a tower of any height."""
        top = self._blocks[self._blueprint.positions[-1].kind][0]
        if top in self._cubes or top is self._held:
            return True
        gripper = self._scene.robot.model.gripper
        reach = max(gripper.palm[0] / 2.0, gripper.half_width()) + tower[0].spec.planar_radius
        return planar_distance(tower[0].pose.position, top.pose.position) > reach

    def _lies_on(self, bottom: SceneObject, top: SceneObject) -> bool:
        return predicates.on_top(self._scene, bottom, top)

    def _preference(self, block: SceneObject, there: Sequence[SceneObject]) -> tuple[float, ...]:
        return (self._distance(block),)

    def _distance(self, block: SceneObject) -> float:
        return planar_distance(block.pose.position, self._scene.robot.pose.position)

    def _yaw(self, block: SceneObject) -> float:
        return side_yaw(block.pose) if block in self._cubes else block.pose.yaw


def _sample(place: Callable[[float], Pose]) -> Pose | None:
    """Return a sample with the largest possible gap (m) to other blocks."""
    for margin in MARGINS:
        with suppress(PlacementError):
            return place(margin)
    return None


def _bottom(block: SceneObject) -> Pose:
    """Return the frame at the bottom centre of an upright block, in the block's frame."""
    low, high = block.spec.mesh.bounds.tolist()
    return Pose(((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]))


def _long_axis(block: SceneObject) -> float:
    """Return the direction (rad) of the blocks above a block: along it if it is long, else along a side."""
    return predicates.heading(block) if is_long(block) else side_yaw(block.pose) + math.pi / 2.0
