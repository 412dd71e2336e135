"""Reaching for a block, and picking it up from the surface or a corner, or into a bowl."""

import math
from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint, approach
from bulletarm_gym.experts.approach import grasp, grasp_object, pass_above, place_object, side_yaw
from bulletarm_gym.geometry import FloatArray, Pose, planar_distance, wrap_angle
from bulletarm_gym.objects import bowl, corner, cube
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.objects.containers import BOWL_HEIGHT, CORNER_INSIDE, CORNER_PLATE, CORNER_SIDE
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.predicates import is_empty, is_held, success_at_rest, touching, upright
from bulletarm_gym.scene.sampling import is_within, random_yaw, sample_until, scatter, stand
from bulletarm_gym.tasks.task import Task

REACHED = 0.03
"""Distance (m) that counts as reached (paper, Block Reaching)."""
BORDER_MARGIN = 1.2
"""Distance of a cube's centre to the border, relative to the largest cube's side."""
CENTRED = 0.03
"""Largest distance (m) of the cube's centre to the bowl's axis at success."""
BOWL_BORDER = 0.53
"""Distance of the bowl's axis to the border, relative to its diameter: 8.5 cm."""
RIM_CLEARANCE = 0.06
"""Distance (m) between the cube's centre and the bowl's rim, for the gripper's fingers."""
RELEASE_HEIGHT = 0.35
"""Height of the release relative to the bowl's height, where the open fingers still fit into the bowl."""
WALL_CLEARANCE = 2e-4
"""Gap (m) between the cube and the walls at the start, so that they exert no force."""
PRESS = 1e-3
"""Depth (m) of the fingertips' target below the cube's upper side; twice this depth may block the arm."""
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


class BlockReaching(Task):
    """Move the fingertips to a cube.

    Description: one 5 cm cube stands on the surface.
    Randomisation: the cube's position in the workspace, its yaw in +-90 degrees.
    Success: the fingertips are within 3 cm of the cube's centre.
    Expert: move straight to the cube's centre.
    """

    instructions = (
        "Move the gripper to a cube{surface}.",
        "Reach for the cube{surface}.",
        "Touch the cube{surface}.",
    )
    defaults = TaskDefaults(num_objects=1)
    controls = (CLOSE_LOOP,)

    spread: ClassVar[float] = math.pi / 2.0
    """Largest absolute yaw (rad) of the cube at the start."""

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        return [scaled(config, "cube", cube)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        block = scene["cube"]
        (point,) = scatter(scene, rng, [BORDER_MARGIN * block.spec.extents[0]], 0.0)
        stand(scene, block, point, rng, self.spread)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        distance = math.dist(scene.robot.pose.position, scene["cube"].pose.position)
        return {"success": distance < REACHED}

    def goals(self, scene: Scene) -> tuple[FloatArray, FloatArray]:
        """Return the positions (m) of the fingertips and of the cube's centre, (3,) each."""
        return np.array(scene.robot.pose.position), np.array(scene["cube"].pose.position)

    def goal_error(self, achieved: FloatArray, desired: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(achieved - desired, axis=-1) / REACHED)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        target, tool = scene["cube"].pose, scene.robot.pose
        rotation = wrap_angle(target.yaw - tool.yaw, math.pi / 2.0)
        yield Waypoint(Pose.planar(*target.position, tool.yaw + rotation), OPEN)


class Lift(Task):
    """Base class of tasks in which the gripper lifts an object higher than ``lift_height``."""

    controls = (CLOSE_LOOP,)
    goals, goal_error = Task.goals, Task.goal_error  # subclasses also extend a task with goals

    @property
    def height(self) -> float:
        """Height (m) to which the gripper must lift, if the success depends on it."""
        return self.config.lift_height if self.defaults.lifts else super().height

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        held = not is_empty(scene)
        return {"success": held and scene.robot.pose.z > self.config.lift_height, "is_held": held}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        tool = scene.robot.pose
        if is_empty(scene):
            yield from self.plan_grasp(scene, rng)
        height = max(tool.z, self.config.lift_height) + scene.max_translation
        yield Waypoint(Pose.planar(tool.x, tool.y, height, tool.yaw), CLOSED)

    @abstractmethod
    def plan_grasp(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Yield the waypoints of the grasp."""


class BlockPicking(Lift, BlockReaching):
    """Grasp a cube and lift it.

    Description: one 5 cm cube stands on the surface.
    Randomisation: the cube's position in the workspace, its yaw in +-45 degrees.
    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    Expert: descend to the cube's centre with the fingers along its sides, close, lift.
    """

    instructions = (
        "Grasp a cube{surface} and lift it.",
        "Pick up the cube{surface}.",
        "Lift the cube{surface}.",
    )
    defaults = TaskDefaults(num_objects=1, lifts=True)
    spread = math.pi / 4.0

    def plan_grasp(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        block = scene["cube"]
        symmetry = approach.side_symmetry(block.pose)
        yaw = block.pose.yaw if symmetry < math.pi else side_yaw(block.pose)
        target = Pose.planar(*block.pose.position, yaw)
        yield from grasp(scene, target, scene.world.top(block.body), symmetry)


class BlockInBowl(Task):
    """Put a cube into a bowl.

    Description: a 5 cm cube and a bowl of 16 x 16 x 7 cm stand on the surface.
    Randomisation: the positions of both, with space for the gripper between them, their yaws in +-90 degrees.
    Success: the cube's centre is within 3 cm of the bowl's axis and the cube touches the bowl, which is
    upright; the gripper is empty and nothing moves.
    Expert: grasp the cube, lift, move above the bowl, lower, open.
    """

    instructions = ("Put a cube into a bowl{surface}.", "Place the cube in the bowl{surface}.")
    defaults = TaskDefaults(num_objects=2, allowed_objects=(2,))
    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """Height (m) of the fingertips above the rim with half a cube below them."""
        return (BOWL_HEIGHT + CUBE_SIZE / 2.0) * max(self.config.scales)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        return [scaled(config, "cube", cube), scaled(config, "bowl", bowl)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        block, vessel = scene["cube"], scene["bowl"]
        margins = [BOWL_BORDER * vessel.spec.extents[0], BORDER_MARGIN * block.spec.extents[0]]
        vessel_point, point = scatter(scene, rng, margins, vessel.spec.planar_radius + RIM_CLEARANCE)
        stand(scene, vessel, vessel_point, rng, math.pi / 2.0)
        stand(scene, block, point, rng, math.pi / 2.0)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        block, vessel = scene["cube"], scene["bowl"]
        centred = planar_distance(block.pose.position, vessel.pose.position) < CENTRED
        return success_at_rest(
            scene, is_in_bowl=centred and touching(scene, block, vessel), is_upright=upright(vessel)
        )

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        block, vessel = scene["cube"], scene["bowl"]
        if is_held(scene, block):
            height = vessel.lowest + RELEASE_HEIGHT * vessel.spec.extents[2]
            yield from place_object(scene, block, vessel.pose.position, height)
        else:
            yield from grasp_object(scene, block, side_yaw(block.pose), math.pi / 2.0)


class CornerPicking(Lift):
    """Get a cube out of a corner and lift it.

    Description: a 5 cm cube stands in a corner, next to both of its walls, which are 8 cm high and fixed; the
    fingers do not fit between them and the cube.
    Randomisation: the corner's position and yaw, the cube with it; with a fixed orientation the yaw is 0.
    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    Expert: press the closed gripper on the cube and draw it out of the corner, then as in Block Picking.
    """

    instructions = ("Get a cube out of a corner and lift it.", "Pick up the cube in the corner.")
    defaults = TaskDefaults(
        num_objects=1,
        lifts=True,
        no_tray="the corner does not fit into the tray",
        level_ground="the corner's plate lies on level ground",
    )

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        return [scaled(config, "cube", cube), ObjectSlot("corner", (corner("corner"),))]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        block, walls = scene["cube"], scene["corner"]
        inset = CORNER_INSIDE + block.spec.extents[0] / 2.0 + WALL_CLEARANCE
        place = Pose((inset, inset, CORNER_PLATE + block.spec.extents[2] / 2.0))

        def draw() -> Pose:
            point = scene.surface.sample_position(rng, CORNER_SIDE / 2.0)
            return scene.surface.pose(point, random_yaw(scene, rng, math.pi))

        pose = sample_until(
            draw, lambda frame: is_within(scene, frame.transform(place.position), block.spec.planar_radius)
        )
        walls.place(pose)
        block.place(pose.compose(place))

    def plan_grasp(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        block, walls, tool = scene["cube"], scene["corner"].pose, scene.robot.pose
        half, top = block.spec.extents[0] / 2.0, scene.world.top(block.body)
        inner = walls.inverse().transform(block.pose.position)
        if min(inner[:2]) - CORNER_INSIDE - half < FREE:
            x, y, _ = walls.transform((inner[0] - OFFSET, inner[1] - OFFSET, 0.0))
            apart = planar_distance((x, y), tool.position)
            closed = scene.robot.opening_ratio < SHUT
            if not (closed and apart < PRESSING_RADIUS and tool.z < top):
                if apart > DESCENT_RADIUS or not closed:
                    highest = approach.highest_between(scene, tool.position, block.pose.position, block)
                    over = max(top, highest) + approach.HOVER
                    yield from pass_above(tool, Pose.planar(x, y, over, tool.yaw), over)
                yield Waypoint(Pose.planar(x, y, top - PRESS, tool.yaw), CLOSED)
            drawn = CORNER_INSIDE + half + DRAWN - OFFSET
            goal = walls.transform((drawn, drawn, 0.0))
            dx, dy = tool.x - x, tool.y - y
            pressed = Pose.planar(goal[0] + dx, goal[1] + dy, top - PRESS, tool.yaw)
            yield Waypoint(pressed, CLOSED, straight=True)
        yield from grasp_object(scene, block, side_yaw(block.pose), math.pi / 2.0)
