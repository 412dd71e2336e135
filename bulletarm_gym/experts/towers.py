"""Planning of a tower of cubes under closed-loop control."""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.approach import RELEASE, grasp_object, place_object, side_yaw
from bulletarm_gym.experts.blueprint import Placed
from bulletarm_gym.experts.builder import Builder
from bulletarm_gym.geometry import planar_distance, wrap_angle
from bulletarm_gym.scene import SceneObject
from bulletarm_gym.scene.predicates import is_held, on_surface, on_top
from bulletarm_gym.scene.sampling import most_free_point


class TowerBuilder(Builder):
    """Builder of a tower of cubes, with a different block on top or without, by closed-loop waypoints.

    The cube nearest to the gripper is grasped next. While a cube is grasped, the nearest tower is extended.
    The plan is therefore visible and does not change while the gripper moves.
    """

    _lies_on = staticmethod(on_top)

    def plan(self) -> Iterator[Waypoint]:
        """Yield the waypoints of the next block."""
        scene, held = self._scene, self._scene.held
        if held is None:
            block = self._next
            yield from grasp_object(scene, block, self._yaw(block), self._symmetry(block))
        elif self._placed and self._open_position(held) is not None:
            below = list(self._placed.values())[-1]
            rotation = wrap_angle(self._yaw(below) - self._yaw(held), math.pi / 2.0)
            height = scene.world.top(below.body) + RELEASE
            yield from place_object(scene, held, below.pose.position, height, rotation)
        else:
            spot = most_free_point(scene, held)
            yield from place_object(scene, held, spot, scene.surface.height(spot) + RELEASE)

    @cached_property
    def _placed(self) -> Placed:
        """The highest tower; of equal ones the nearest while a block is grasped, else the farthest."""
        nearest_first = sorted(self._cubes, key=self._distance)
        bases = nearest_first if self._scene.held is not None else reversed(nearest_first)
        towers = (self._tower(cube) for cube in bases if not is_held(self._scene, cube))
        best = max(towers, key=lambda tower: (len(tower), self._leaves_space(tower)), default=[])
        return dict(zip(self._blueprint.positions, best, strict=False))

    @property
    def _cubes(self) -> Sequence[SceneObject]:
        return self._blocks[self._blueprint.positions[0].kind]

    def _tower(self, base: SceneObject) -> list[SceneObject]:
        """Return a cube and, if it is on the surface, the cubes on it."""
        tower = [base]
        while on_surface(self._scene, base) and (above := self._above(tower[-1])) in self._cubes:
            tower.append(above)
        return tower

    def _leaves_space(self, tower: Sequence[SceneObject]) -> bool:
        """Return True if the block on top can be grasped next to a tower of any height."""
        top = self._blocks[self._blueprint.positions[-1].kind][0]
        if top in self._cubes or is_held(self._scene, top):
            return True
        gripper = self._scene.robot.model.gripper
        reach = max(gripper.palm[0] / 2.0, gripper.half_width()) + tower[0].spec.planar_radius
        return planar_distance(tower[0].pose.position, top.pose.position) > reach

    def _preference(self, block: SceneObject, there: Sequence[SceneObject]) -> tuple[float, ...]:
        return (self._distance(block),)

    def _distance(self, block: SceneObject) -> float:
        return planar_distance(block.pose.position, self._scene.robot.pose.position)

    def _yaw(self, block: SceneObject) -> float:
        return side_yaw(block.pose) if block in self._cubes else block.pose.yaw

    def _symmetry(self, block: SceneObject) -> float:
        return math.pi / 2.0 if block in self._cubes else math.pi
