"""Picking up a block out of a corner."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.experts.approach import (
    HEIGHT_TOLERANCE,
    HOVER,
    grasp_item,
    highest_between,
    side_yaw,
)
from bulletarm_gym.experts.waypoints import CLOSED, Waypoint
from bulletarm_gym.geometry import Pose, planar_distance
from bulletarm_gym.objects import corner, cube
from bulletarm_gym.objects.containers import CORNER_INSIDE, CORNER_PLATE, CORNER_SIDE
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.sampling import is_within, sample_until
from bulletarm_gym.tasks.picking import Lift

WALL_CLEARANCE = 2e-4
"""Gap (m) between the cube and the walls: it stands flush, but is not pressed against them."""
PRESS = 1e-3
"""Depth (m) by which the fingertips are sent into the cube's upper side; half and twice as much take it along
too, but from twice as much on the arm may be blocked."""
FREE = 0.05
"""Distance (m) of the cube from the walls at which any gripper's fingers fit in between ..."""
DRAWN = 0.07
"""... and that to which the expert draws it: clearly farther, so that one sees when it is done."""
OFFSET = 0.004
"""How far (m) from the cube's middle, towards both walls, it presses: there the cube does not tip over."""
SHUT = 0.1
"""Opening ratio up to which the gripper presses with both fingers."""
DESCENT_RADIUS = 0.02
"""Distance (m) from there within which the gripper comes down ..."""
PRESSING_RADIUS = 0.025
"""... and within which it presses on the cube."""


class CornerPicking(Lift):
    """Get a cube out of a corner and lift it.

    Description: a 5 cm cube stands in a corner, touching both of its walls, which are 8 cm high and fixed;
    the fingers do not fit between them and the cube.
    Randomisation: the corner's position and yaw, the cube with it; with a fixed orientation the walls lie
    along the axes.
    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    Expert: press the closed gripper on the cube and draw it out of the corner, up, then as in Block Picking.
    """

    defaults = TaskDefaults(
        num_objects=1,
        lifts=True,
        tray=TrayUse((False,), "the corner does not fit into the tray"),
        level_ground="the corner's plate lies on level ground",
    )

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cube and the corner."""
        return [scaled(config, "cube", cube), ObjectSlot("corner", (corner("corner"),))]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the corner where the cube in it is inside the workspace."""
        item, walls = scene["cube"], scene["corner"]
        half = item.spec.extents[0] / 2.0
        inset = CORNER_INSIDE + half + WALL_CLEARANCE
        place = Pose((inset, inset, CORNER_PLATE + item.spec.extents[2] / 2.0))

        def draw() -> Pose:
            return scene.surface.pose(scene.surface.sample_position(rng, CORNER_SIDE / 2.0), self._yaw(rng))

        pose = sample_until(
            draw, lambda frame: is_within(scene, frame.transform(place.position), item.spec.planar_radius)
        )
        walls.place(pose)
        item.place(pose.compose(place))

    def _yaw(self, rng: np.random.Generator) -> float:
        if self.config.random_orientation:
            return float(rng.uniform(-math.pi, math.pi))
        return int(rng.integers(4)) * math.pi / 2.0

    def _grasp(self, scene: Scene) -> Iterator[Waypoint]:
        """Nudge the cube out of the corner first, where it still stands in it."""
        item = scene["cube"]
        x, y, _ = scene["corner"].pose.inverse().transform(item.pose.position)
        if min(x, y) - CORNER_INSIDE - item.spec.extents[0] / 2.0 < FREE:
            yield from self._nudge(scene)
        yield from grasp_item(scene, item, side_yaw(item.pose), math.pi / 2.0)

    def _nudge(self, scene: Scene) -> Iterator[Waypoint]:
        """Press on the cube with the closed gripper, and draw it to the middle of the plate."""
        item, walls, hand = scene["cube"], scene["corner"], scene.robot.pose
        inner = walls.pose.inverse().transform(item.pose.position)
        x, y, _ = walls.pose.transform((inner[0] - OFFSET, inner[1] - OFFSET, 0.0))
        top = scene.world.top(item.body)
        beside = planar_distance((x, y), hand.position)
        closed = scene.robot.opening_ratio < SHUT
        if not (closed and beside < PRESSING_RADIUS and hand.z < top):
            if beside > DESCENT_RADIUS or not closed:
                over = max(top, highest_between(scene, hand.position, item.pose.position, item)) + HOVER
                if hand.z < over - HEIGHT_TOLERANCE:
                    yield Waypoint(Pose.planar(hand.x, hand.y, over, hand.yaw), CLOSED)
                yield Waypoint(Pose.planar(x, y, over, hand.yaw), CLOSED)
            yield Waypoint(Pose.planar(x, y, top - PRESS, hand.yaw), CLOSED)
        half = item.spec.extents[0] / 2.0
        goal = walls.pose.transform(
            (CORNER_INSIDE + half + DRAWN - OFFSET, CORNER_INSIDE + half + DRAWN - OFFSET, 0.0)
        )
        dx, dy = hand.x - x, hand.y - y
        yield Waypoint(Pose.planar(goal[0] + dx, goal[1] + dy, top - PRESS, hand.yaw), CLOSED, straight=True)
