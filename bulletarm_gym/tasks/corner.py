"""Picking a block up from a corner."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.experts.approach import HOVER, grasp_object, highest_between, pass_above, side_yaw
from bulletarm_gym.experts.waypoints import CLOSED, Waypoint
from bulletarm_gym.geometry import Pose, planar_distance
from bulletarm_gym.objects import corner, cube
from bulletarm_gym.objects.corner import INSIDE, PLATE, SIDE
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.sampling import is_within, sample_until
from bulletarm_gym.tasks.picking import Lift

WALL_CLEARANCE = 2e-4
"""Gap (m) between the cube and the walls at the start, so that they exert no force."""
PRESS = 1e-3
"""Depth (m) of the fingertips' target below the cube's upper side.

Half and twice this depth move the cube too; from twice this depth on the arm may be blocked.
"""
FREE = 0.05
"""Distance (m) of the cube from the walls at which the fingers of any gripper fit in between."""
DRAWN = 0.07
"""Distance (m) from the walls to which the expert draws the cube, visibly more than :data:`FREE`."""
OFFSET = 0.004
"""Distance (m) of the pressed point from the cube's centre, towards both walls, to keep it upright."""
SHUT = 0.1
"""Largest opening ratio at which the gripper presses with both fingers."""
DESCENT_RADIUS = 0.02
"""Horizontal distance (m) from the pressed point within which the gripper descends."""
PRESSING_RADIUS = 0.025
"""Horizontal distance (m) from the pressed point within which the gripper presses on the cube."""


class CornerPicking(Lift):
    """Get a cube out of a corner and lift it.

    Description: a 5 cm cube stands in a corner, next to both of its walls, which are 8 cm high and fixed; the
    fingers do not fit between them and the cube.
    Randomisation: the corner's position and yaw, the cube with it; with a fixed orientation the walls lie
    along the axes.
    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    Expert: press the closed gripper on the cube and draw it out of the corner, then as in Block Picking.
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
        """Place the corner so that the cube in it is inside the workspace."""
        block, walls = scene["cube"], scene["corner"]
        inset = INSIDE + block.spec.extents[0] / 2.0 + WALL_CLEARANCE
        place = Pose((inset, inset, PLATE + block.spec.extents[2] / 2.0))

        def draw() -> Pose:
            return scene.surface.pose(scene.surface.sample_position(rng, SIDE / 2.0), self._yaw(rng))

        pose = sample_until(
            draw, lambda frame: is_within(scene, frame.transform(place.position), block.spec.planar_radius)
        )
        walls.place(pose)
        block.place(pose.compose(place))

    def _yaw(self, rng: np.random.Generator) -> float:
        if self.config.random_orientation:
            return float(rng.uniform(-math.pi, math.pi))
        return int(rng.integers(4)) * math.pi / 2.0

    def _grasp(self, scene: Scene) -> Iterator[Waypoint]:
        """Draw the cube out of the corner first, if it is still there."""
        block, walls, tool = scene["cube"], scene["corner"].pose, scene.robot.pose
        half, top = block.spec.extents[0] / 2.0, scene.world.top(block.body)
        inner = walls.inverse().transform(block.pose.position)
        if min(inner[:2]) - INSIDE - half < FREE:
            x, y, _ = walls.transform((inner[0] - OFFSET, inner[1] - OFFSET, 0.0))
            apart = planar_distance((x, y), tool.position)
            closed = scene.robot.opening_ratio < SHUT
            if not (closed and apart < PRESSING_RADIUS and tool.z < top):
                if apart > DESCENT_RADIUS or not closed:
                    over = max(top, highest_between(scene, tool.position, block.pose.position, block)) + HOVER
                    yield from pass_above(tool, Pose.planar(x, y, over, tool.yaw), over)
                yield Waypoint(Pose.planar(x, y, top - PRESS, tool.yaw), CLOSED)
            drawn = INSIDE + half + DRAWN - OFFSET
            goal = walls.transform((drawn, drawn, 0.0))
            dx, dy = tool.x - x, tool.y - y
            pressed = Pose.planar(goal[0] + dx, goal[1] + dy, top - PRESS, tool.yaw)
            yield Waypoint(pressed, CLOSED, straight=True)
        yield from grasp_object(scene, block, side_yaw(block.pose), math.pi / 2.0)
