"""Deciding which block goes where next to build a tower: a tool that tasks' experts share."""

import math
from collections.abc import Iterator, Sequence

from bulletarm_gym.experts.approach import RELEASE, grasp_item, place_item, side_yaw
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import planar_distance, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import is_held, on_surface, on_top
from bulletarm_gym.scene.sampling import most_free_point

CUBE_SYMMETRY = math.pi / 2.0
CROWN_SYMMETRY = math.pi


class Tower:
    """A tower of cubes as far as it stands, and what is to be done next.

    :param cubes: in any order, one on another
    :param crown: what comes on top in the end; it is grasped along its x axis
    """

    def __init__(self, scene: Scene, cubes: Sequence[SceneObject], crown: SceneObject | None = None) -> None:
        self._scene = scene
        self._crown = crown
        self._blocks = [*cubes, crown] if crown is not None else list(cubes)
        # Of equal cubes the nearest is grasped, and built on when one is held: what to do can then be seen,
        # and stays as the gripper comes nearer.
        nearest_first = sorted(cubes, key=self._distance)
        bases = nearest_first if scene.held is not None else reversed(nearest_first)
        piles = (self._pile(cube, cubes) for cube in bases if not is_held(scene, cube))
        self._standing = max(piles, key=lambda pile: (len(pile), self._leaves_room(pile)), default=[])
        self._missing = [cube for cube in nearest_first if cube not in self._standing]

    def plan(self) -> Iterator[Waypoint]:
        """Yield the waypoints of the next block."""
        item = self._next
        if not is_held(self._scene, item):
            yield from grasp_item(self._scene, item, self._yaw(item), self._symmetry(item))
        elif self._fits(item):
            yield from self._put_on(item, self._standing[-1])
        else:
            spot = most_free_point(self._scene, item)
            height = self._scene.surface.height(spot) + RELEASE
            yield from place_item(self._scene, item, spot, height)

    @property
    def _next(self) -> SceneObject:
        """The block to move: what is held, else what lies on those it should not, else what is missing."""
        held = self._scene.held
        if held is not None:
            return held
        in_the_way = self._above(self._standing[-1])
        if in_the_way is not None:
            return in_the_way
        wanted = self._missing[0] if self._missing else self._blocks[-1]
        while (above := self._above(wanted)) is not None:
            wanted = above
        return wanted

    def _fits(self, item: SceneObject) -> bool:
        """Whether an item belongs on the tower now."""
        if not self._standing or item in self._standing or (item is self._crown and self._missing):
            return False
        return self._above(self._standing[-1]) is None

    def _put_on(self, item: SceneObject, below: SceneObject) -> Iterator[Waypoint]:
        turn = wrap_angle(self._yaw(below) - self._yaw(item), CUBE_SYMMETRY)
        height = self._scene.world.top(below.body) + RELEASE
        yield from place_item(self._scene, item, below.pose.position, height, turn)

    def _pile(self, base: SceneObject, cubes: Sequence[SceneObject]) -> list[SceneObject]:
        """Return a cube and, if it is on the ground, the cubes on it, from the bottom up."""
        pile = [base]
        if on_surface(self._scene, base):
            while (above := self._above(pile[-1], cubes)) is not None:
                pile.append(above)
        return pile

    def _leaves_room(self, pile: Sequence[SceneObject]) -> bool:
        """Whether the crown can be grasped beside a pile, however high it grows."""
        if self._crown is None or is_held(self._scene, self._crown):
            return True
        gripper = self._scene.robot.model.gripper
        room = max(gripper.palm[0] / 2.0, gripper.half_width()) + pile[0].spec.planar_radius
        return planar_distance(pile[0].pose.position, self._crown.pose.position) > room

    def _above(self, item: SceneObject, pool: Sequence[SceneObject] | None = None) -> SceneObject | None:
        """Return the block that lies on an item."""
        others = (block for block in (pool or self._blocks) if block is not item)
        free = (block for block in others if not is_held(self._scene, block))
        return next((block for block in free if on_top(self._scene, item, block)), None)

    def _distance(self, item: SceneObject) -> float:
        return planar_distance(item.pose.position, self._scene.robot.pose.position)

    def _yaw(self, item: SceneObject) -> float:
        return item.pose.yaw if item is self._crown else side_yaw(item.pose)

    def _symmetry(self, item: SceneObject) -> float:
        return CROWN_SYMMETRY if item is self._crown else CUBE_SYMMETRY
