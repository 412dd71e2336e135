"""Bringing one block to another without lifting it."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.objects import flat_block
from bulletarm_gym.placement import scatter, stand
from bulletarm_gym.relations import touching
from bulletarm_gym.scene import Item, Role, Scene, scaled
from bulletarm_gym.tasks.task import HALF_OPEN, Task, Waypoint

YAW_SPREAD = math.pi / 2.0
BORDER = 0.85
"""Distance of a block's centre to the border, in block sides, as in the original BulletArm release."""
GAP = 1.7
"""Least distance of the blocks' centres, in block sides, as in the original BulletArm release."""
BEHIND = 0.08
"""Where (m) the gripper comes down behind the centre of the block it pulls."""
ABOVE = 0.1
"""Height (m) of the fingertips on the way to it."""
LOW = 0.03
"""Height (m) of the fingertips while they pull."""
ASTRAY = 0.035
"""Distance (m) from the line between the blocks at which a pull is begun anew."""
NAMES = ("near block", "far block")


class BlockPulling(Task):
    """Pull one of two blocks until it touches the other.

    Description: two blocks of 8 x 8 x 5 cm stand on the floor, too wide for the gripper.
    Randomisation: the blocks' positions in the workspace, at least 1.7 sides apart, their yaws in +-90
    degrees; with a fixed orientation both lie along y, side by side.
    Success: the blocks touch.
    Expert: over the far side of a block, down behind it, and with it to the other.
    """

    defaults = TaskDefaults(num_objects=2, object_scale=0.8, allowed_objects=(2,))
    controls = (CLOSE_LOOP,)

    def bodies(self, config: EnvConfig) -> list[Role]:
        """Return the two blocks."""
        return [scaled(config, name, flat_block) for name in NAMES]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the blocks apart."""
        items = [scene[name] for name in NAMES]
        side = max(item.spec.extents[0] for item in items)
        points = scatter(
            scene, rng, [BORDER * side] * 2, GAP * side, aligned=not self.config.random_orientation
        )
        for item, point in zip(items, points, strict=True):
            stand(scene, item, point, rng, YAW_SPREAD)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the blocks touch."""
        return {"success": touching(scene, scene[NAMES[0]], scene[NAMES[1]])}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Go behind the block that is easier to get behind, and pull it to the other."""
        first, second = (scene[name] for name in NAMES)
        yield from min(
            (Pull(scene, first, second), Pull(scene, second, first)), key=lambda pull: pull.effort
        ).plan()


class Pull:
    """One block being pulled to another."""

    def __init__(self, scene: Scene, block: Item, goal: Item) -> None:
        self._hand = scene.robot.pose
        self._goal = goal.pose
        self._block = block.pose
        dx, dy = goal.pose.x - block.pose.x, goal.pose.y - block.pose.y
        length = math.hypot(dx, dy)
        self._line = (dx / length, dy / length)
        across = math.atan2(dy, dx) + math.pi / 2.0
        self._yaw = self._hand.yaw
        if "r" in scene.config.action_sequence:
            self._yaw += wrap_angle(across - self._hand.yaw, math.pi)
        self._start = (block.pose.x - BEHIND * self._line[0], block.pose.y - BEHIND * self._line[1])
        self._outside = _distance_outside(self._start, scene.config.workspace)

    @property
    def effort(self) -> float:
        """How far (m) the gripper would have to go; being behind the block already counts most."""
        if self._is_behind:
            return -1.0
        return 10.0 * self._outside + planar_distance(self._start, self._hand.position)

    @property
    def _is_behind(self) -> bool:
        """Whether the gripper is in place to pull."""
        dx, dy = self._hand.x - self._block.x, self._hand.y - self._block.y
        along = dx * self._line[0] + dy * self._line[1]
        aside = abs(dx * self._line[1] - dy * self._line[0])
        return along < 0.0 and aside < ASTRAY and self._hand.z < LOW + 0.01 and -along < 2.0 * BEHIND

    @property
    def _is_over_start(self) -> bool:
        return planar_distance(self._start, self._hand.position) < 0.01 + 1.5 * self._outside

    def plan(self) -> Iterator[Waypoint]:
        """Yield what remains of: over the start, down, to the other block."""
        if not self._is_behind:
            if not self._is_over_start:
                if self._hand.z < ABOVE - 0.04:
                    yield Waypoint(Pose.planar(self._hand.x, self._hand.y, ABOVE, self._hand.yaw), HALF_OPEN)
                yield Waypoint(Pose.planar(*self._start, ABOVE, self._yaw), HALF_OPEN)
            yield Waypoint(Pose.planar(*self._start, LOW, self._yaw), HALF_OPEN)
        yield Waypoint(Pose.planar(self._goal.x, self._goal.y, LOW, self._yaw), HALF_OPEN, straight=True)


def _distance_outside(point: tuple[float, float], workspace: list[list[float]]) -> float:
    """Return how far (m) a point is beyond the border in x or y, 0 inside."""
    return max(
        max(low - value, value - high, 0.0) for value, (low, high) in zip(point, workspace, strict=False)
    )
