"""Sorting blocks by colour."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts import HALF_OPEN, Waypoint, approach
from bulletarm_gym.experts.approach import grasp, highest_between, place_object, rotates, side_yaw
from bulletarm_gym.experts.pick_place import fingers_fit
from bulletarm_gym.geometry import Footprint, Pose, wrap_angle
from bulletarm_gym.objects import bowl, cube
from bulletarm_gym.objects.containers import BOWL_DIAMETER, BOWL_HEIGHT, BOWL_THICKNESS
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import success_at_rest, upright
from bulletarm_gym.scene.sampling import footprint, place_apart, sample_until
from bulletarm_gym.simulation.shapes import BLUE, RED, BodySpec, Colour
from bulletarm_gym.tasks.stacking import SCALE
from bulletarm_gym.tasks.task import Task

COLOURS = {"red": RED, "blue": BLUE}
BOWL_SCALE = 4.0 / 3.0
"""Scale of a bowl relative to a cube, so that two cubes fit side by side on its floor."""
SPACING = 0.02
"""Smallest gap (m) between two objects at the start."""
FROM_AXIS = 0.32
"""Distance of a cube from the bowl's axis at its release, relative to its side."""
RELEASE_HEIGHT = 0.6
"""Height of a cube's lowest point at its release relative to the bowl's; the fingers are near the rim."""
FINGER_AREA = (0.135, 0.03)
"""Length and width (m) of the free area around a cube at the start for the open fingers of any gripper."""
OFFSETS = (0.0, -approach.ALIGNED, approach.ALIGNED)
"""Offsets (m) of the descent from a cube's centre."""


class BlockSorting(Task):
    """Put the cubes of each of two colours into the bowl of their colour.

    Description: two red and two blue cubes (or one of each) of 3 cm, a red and a blue bowl of
    12.8 x 12.8 x 5.6 cm stand on the surface.
    Randomisation: positions and yaws of all objects, at least 2 cm apart, with space for the gripper around
    each cube.
    Success: the centre of every cube is in the bowl of its colour, below the rim; the gripper is empty and
    nothing moves.
    Validity: no bowl has fallen over.
    Expert: repeat until solved: grasp a cube, lift, move above its bowl next to the cube in it, lower, open.

    Heights do not show the colours, so that ``color`` is observed by default, too.
    """

    instructions = (
        "Put each cube into the bowl of its color.",
        "Sort the cubes by color into the bowls.",
        "Put the red cubes into the red bowl and the blue cubes into the blue bowl.",
    )
    defaults = TaskDefaults(
        num_objects=6,
        max_steps=20,
        object_scale=SCALE,
        allowed_objects=(4, 6),
        no_tray="two bowls and the cubes do not fit into it",
        level_ground="bowls slide on a slope",
        sensors=("color",),
        close_loop={"max_steps": 100},
    )
    controls = (CLOSE_LOOP, OPEN_LOOP)

    @property
    def height(self) -> float:
        """Height (m) of the fingertips above the rim with half a cube below them."""
        return super().height / 2.0 + BOWL_HEIGHT * BOWL_SCALE * max(self.config.scales)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        pairs = range((config.num_objects - len(COLOURS)) // len(COLOURS))
        bowls = [scaled(config, f"{name} bowl", partial(_bowl, colour)) for name, colour in COLOURS.items()]
        return bowls + [
            scaled(config, f"{name} cube {number}", replace(cube, colour=colour), name)
            for number in pairs
            for name, colour in COLOURS.items()
        ]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        sample_until(
            lambda: place_apart(scene, rng, scene.objects, SPACING),
            lambda _: all(_has_space(scene, block) for block in _cubes(scene)),
        )

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        placed = all(_is_in(_bowl_of(scene, block), block) for block in _cubes(scene))
        return success_at_rest(scene, is_sorted=placed)

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        cubes = _cubes(scene)
        released = (block for block in cubes if block is not scene.held)
        return sum(_is_in(_bowl_of(scene, block), block) for block in released), len(cubes)

    def is_valid(self, scene: Scene) -> bool:
        return super().is_valid(scene) and all(upright(scene[f"{name} bowl"]) for name in COLOURS)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        held = scene.held
        if held in _cubes(scene):
            yield from _put(scene, held)
        elif held is not None:  # a bowl
            spot = held.pose.position
            height = highest_between(scene, spot, spot, held) + approach.RELEASE
            yield from place_object(scene, held, spot[:2], height)
        else:
            yield from _take(scene)


def _cubes(scene: Scene) -> list[SceneObject]:
    return scene.objects[len(COLOURS) :]


def _bowl_of(scene: Scene, block: SceneObject) -> SceneObject:
    return scene[f"{block.slot.kind} bowl"]


def _take(scene: Scene) -> Iterator[Waypoint]:
    """Yield the waypoints of a grasp of a cube outside its bowl, along sides where the open fingers fit."""
    cubes, tool = _cubes(scene), scene.robot.pose
    remaining = [block for block in cubes if not _is_in(_bowl_of(scene, block), block)] or cubes
    block = next((block for block in remaining if _yaws(scene, block)[1]), remaining[0])
    centre = block.centre_of_mass
    yaws, fitting = _yaws(scene, block)
    top = max(scene.world.top(block.body), highest_between(scene, tool.position, centre, block))
    yield from grasp(scene, Pose.planar(*centre, (fitting or yaws)[0]), top, math.pi)


def _put(scene: Scene, held: SceneObject) -> Iterator[Waypoint]:
    """Yield the waypoints of a release in the bowl next to the other cube."""
    vessel, tool = _bowl_of(scene, held), scene.robot.pose
    others = [block for block in _cubes(scene) if block is not held and _is_in(vessel, block)]
    x, y, _ = vessel.pose.position
    # The cubes are in one line, the fingers on both sides of it.
    line = tool.yaw + math.pi / 2.0
    if others:
        line = math.atan2(y - others[0].pose.y, x - others[0].pose.x)
    offset = FROM_AXIS * held.spec.extents[0]
    spot = (x + offset * math.cos(line), y + offset * math.sin(line))
    rotation = wrap_angle(line + math.pi / 2.0 - tool.yaw, math.pi)
    height = vessel.lowest + RELEASE_HEIGHT * vessel.spec.extents[2]
    for waypoint in place_object(scene, held, spot, height, rotation):
        # Completely open fingers would jam in the bowl.
        yield waypoint if waypoint.finish is None else replace(waypoint, finish=HALF_OPEN)


def _has_space(scene: Scene, block: SceneObject) -> bool:
    """Return True if the area for the fingers along one of a cube's sides is free."""
    side = wrap_angle(side_yaw(block.pose), math.pi / 2.0)
    yaws = (side, side + math.pi / 2.0) if rotates(scene) else (side,)
    others = [footprint(other) for other in scene if other is not block]
    areas = (Footprint.rectangle(FINGER_AREA, Pose.planar(*block.centre_of_mass, yaw)) for yaw in yaws)
    return any(area.gap(*others) > 0.0 for area in areas)


def _yaws(scene: Scene, block: SceneObject) -> tuple[list[float], list[float]]:
    """Return the yaws (rad) of a grasp of a cube, the nearest first, and those where the fingers fit."""
    tool, side = scene.robot.pose, side_yaw(block.pose)
    rotations = sorted((wrap_angle(side + yaw - tool.yaw, math.pi) for yaw in (0.0, math.pi / 2.0)), key=abs)
    yaws = [tool.yaw + rotation for rotation in rotations[: 2 if rotates(scene) else 1]]

    def fits(yaw: float) -> bool:
        target = Pose.planar(*block.centre_of_mass, yaw)
        poses = (target.compose(Pose((offset, 0.0, 0.0))) for offset in OFFSETS)
        return all(fingers_fit(scene, pose, block) for pose in poses)

    return yaws, list(filter(fits, yaws))


def _is_in(vessel: SceneObject, block: SceneObject) -> bool:
    """Return True if the centre of a block is inside a bowl, below its rim."""
    x, y, z = vessel.pose.inverse().transform(block.pose.position)
    scale = vessel.spec.extents[0] / BOWL_DIAMETER
    is_below = abs(z) < BOWL_HEIGHT / 2.0 * scale
    return is_below and math.hypot(x, y) < (BOWL_DIAMETER / 2.0 - BOWL_THICKNESS) * scale


def _bowl(colour: Colour, name: str, scale: float) -> BodySpec:
    return replace(bowl, colour=colour)(name, BOWL_SCALE * scale)
