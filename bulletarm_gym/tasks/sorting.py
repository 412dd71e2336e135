"""Sorting blocks by colour."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.experts.approach import ALIGNED, RELEASE, grasp, highest_between, place_item, side_yaw
from bulletarm_gym.experts.pick_place import fingers_fit
from bulletarm_gym.experts.waypoints import HALF_OPEN, Waypoint
from bulletarm_gym.geometry import Footprint, Pose, Vector, planar_distance, wrap_angle
from bulletarm_gym.objects import BodySpec, Colour, bowl, cube
from bulletarm_gym.objects.containers import BOWL_DIAMETER, BOWL_HEIGHT, BOWL_THICKNESS
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import at_rest, is_empty, upright
from bulletarm_gym.scene.sampling import footprint, place_apart, sample_until
from bulletarm_gym.simulation.shapes import BLUE, RED
from bulletarm_gym.tasks.task import Task

COLOURS = {"red": RED, "blue": BLUE}
SCALE = 0.6
"""Cubes of 3 cm, as in the paper's open-loop tasks."""
BOWL_SCALE = 4.0 / 3.0
"""Of a bowl to a cube: two cubes lie side by side on its floor."""
ITEM_SPACING = 0.02
"""Least gap (m) between two things at the start."""
FROM_AXIS = 0.32
"""Distance of a cube from the bowl's axis when it is let go, in its sides: the other one has room."""
RELEASE_HEIGHT = 0.6
"""Height of a cube's lowest point when it is let go, in bowl heights: the open fingers are near the rim."""
FINGER_ROOM = (0.135, 0.03)
"""Length and width (m) kept free around a cube at the start for open fingers, the same for every arm."""
HALF_TURN = math.pi


class BlockSorting(Task):
    """Put the cubes of each of two colours into the bowl of their colour.

    Description: two red and two blue cubes (or one of each) of 3 cm, a red and a blue bowl of
    12.8 x 12.8 x 5.6 cm stand on the floor.
    Randomisation: positions and yaws of all of them, at least 2 cm apart, with
    room for the gripper about each cube.
    Success: the centre of every cube is in the bowl of its colour, below the rim; the gripper is empty and
    nothing moves.
    Validity: no bowl has fallen over.
    Expert: grasp a cube, up, over its bowl, away from the cube that is in it already, down, open; and so on.

    Heights do not tell the colours, so by default ``color`` is observed, too.
    """

    defaults = TaskDefaults(
        num_objects=6,
        max_steps=100,
        object_scale=SCALE,
        allowed_objects=(4, 6),
        tray=TrayUse((False,), "two bowls and the cubes do not fit into it"),
        level_ground="bowls slide on a slope",
        sensors=("color",),
    )
    controls = (CLOSE_LOOP, OPEN_LOOP)

    @property
    def height(self) -> float:
        """The gripper must get over the rim with half a cube below it."""
        return super().height / 2.0 + BOWL_HEIGHT * BOWL_SCALE * max(self.config.scales)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the bowls and the cubes."""
        pairs = range((config.num_objects - len(COLOURS)) // len(COLOURS))
        bowls = [scaled(config, f"{name} bowl", _coloured(_bowl, colour)) for name, colour in COLOURS.items()]
        return bowls + [
            scaled(config, f"{name} cube {number}", _coloured(cube, colour), name)
            for number in pairs
            for name, colour in COLOURS.items()
        ]

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return the cubes: the bowls stay where they are."""
        return self._cubes(scene)

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put everything apart, with room for the gripper about each cube."""
        sample_until(
            lambda: place_apart(scene, rng, scene.objects, ITEM_SPACING),
            lambda _: all(_has_room(scene, item) for item in self._cubes(scene)),
        )

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look where the cubes are, and whether all is done."""
        facts = {
            "is_sorted": all(_is_in(self._bowl_of(scene, item), item) for item in self._cubes(scene)),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace and the bowls stand."""
        return super().is_valid(scene) and all(map(upright, self._bowls(scene)))

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the next cube, or put it into its bowl."""
        held = scene.held
        if held in self._cubes(scene):
            yield from self._put(scene, held)
        elif held is not None:  # a bowl
            spot = held.pose.position
            height = highest_between(scene, spot, spot, held) + RELEASE
            yield from place_item(scene, held, spot[:2], height)
        else:
            yield from _take(scene, self._next(scene))

    def _put(self, scene: Scene, held: SceneObject) -> Iterator[Waypoint]:
        vessel = self._bowl_of(scene, held)
        others = [item for item in self._cubes(scene) if item is not held and _is_in(vessel, item)]
        x, y, _ = vessel.pose.position
        # In a line with the cube that is there, the fingers beside it.
        line = scene.robot.pose.yaw + math.pi / 2.0
        if others and planar_distance(others[0].pose.position, vessel.pose.position) > 0.0:
            line = math.atan2(y - others[0].pose.y, x - others[0].pose.x)
        aside = FROM_AXIS * held.spec.extents[0]
        spot = (x + aside * math.cos(line), y + aside * math.sin(line))
        turn = wrap_angle(line + math.pi / 2.0 - scene.robot.pose.yaw, HALF_TURN)
        height = vessel.lowest + RELEASE_HEIGHT * vessel.spec.extents[2]
        for waypoint in place_item(scene, held, spot, height, turn):
            # Opened all the way the fingers would jam in the bowl.
            yield waypoint if waypoint.finish is None else replace(waypoint, finish=HALF_OPEN)

    def _next(self, scene: Scene) -> SceneObject:
        """Return a cube that is not in its bowl, best one about which there is room; any if all are in."""
        cubes = self._cubes(scene)
        unsorted = [item for item in cubes if not _is_in(self._bowl_of(scene, item), item)]
        free = (item for item in unsorted if _yaws(scene, item)[1])
        return next(free, next(iter(unsorted or cubes)))

    def _bowls(self, scene: Scene) -> list[SceneObject]:
        return [scene[f"{name} bowl"] for name in COLOURS]

    def _cubes(self, scene: Scene) -> list[SceneObject]:
        return scene.objects[len(COLOURS) :]

    def _bowl_of(self, scene: Scene, item: SceneObject) -> SceneObject:
        return scene[f"{item.slot.kind} bowl"]


class OpenLoopBlockSorting(BlockSorting):
    """Put the cubes of each of two colours into the bowl of their colour, by pick and place.

    All else is as in :class:`BlockSorting`.
    """

    defaults = replace(BlockSorting.defaults, max_steps=20)


def _take(scene: Scene, item: SceneObject) -> Iterator[Waypoint]:
    """Yield the way to a grasp of a cube by the sides about which the open fingers have room."""
    centre, hand = item.centre_of_mass, scene.robot.pose
    yaws, fitting = _yaws(scene, item)
    top = max(scene.world.top(item.body), highest_between(scene, hand.position, centre, item))
    yield from grasp(scene, Pose.planar(*centre, (fitting or yaws)[0]), top, HALF_TURN)


def _has_room(scene: Scene, item: SceneObject) -> bool:
    """Return True if a gripper of usual size has room about a cube along one of its sides."""
    side = wrap_angle(side_yaw(item.pose), HALF_TURN / 2.0)
    yaws = (side, side + HALF_TURN / 2.0) if "r" in scene.config.action_sequence else (side,)
    others = [footprint(other) for other in scene if other is not item]
    rooms = (Footprint.rectangle(FINGER_ROOM, Pose.planar(*item.centre_of_mass, yaw)) for yaw in yaws)
    return any(all(room.gap(other) > 0.0 for other in others) for room in rooms)


def _yaws(scene: Scene, item: SceneObject) -> tuple[list[float], list[float]]:
    """Return in which directions (rad) the fingers may close on a cube, and those in which they have room.

    The nearest to the gripper's comes first; if it cannot turn, there is no other.
    """
    hand, side = scene.robot.pose, side_yaw(item.pose)
    turns = sorted(
        (wrap_angle(side + turn - hand.yaw, HALF_TURN) for turn in (0.0, HALF_TURN / 2.0)), key=abs
    )
    yaws = [hand.yaw + turn for turn in turns[: 2 if "r" in scene.config.action_sequence else 1]]
    return yaws, [yaw for yaw in yaws if _fits(scene, item, yaw)]


def _fits(scene: Scene, item: SceneObject, yaw: float) -> bool:
    """Whether open fingers have room about a cube, also a little beside it, as on their way down."""
    target = Pose.planar(*item.centre_of_mass, yaw)
    places = (target.compose(Pose((aside, 0.0, 0.0))) for aside in (0.0, -ALIGNED, ALIGNED))
    return all(fingers_fit(scene, place, item) for place in places)


def _is_in(vessel: SceneObject, item: SceneObject) -> bool:
    """Whether the middle of an item is inside a bowl, below its rim."""
    x, y, z = _local(vessel, item)
    scale = vessel.spec.extents[0] / BOWL_DIAMETER
    return (
        math.hypot(x, y) < (BOWL_DIAMETER / 2.0 - BOWL_THICKNESS) * scale
        and abs(z) < BOWL_HEIGHT / 2.0 * scale
    )


def _local(vessel: SceneObject, item: SceneObject) -> Vector:
    return vessel.pose.inverse().transform(item.pose.position)


def _bowl(name: str, scale: float) -> BodySpec:
    return bowl(name, BOWL_SCALE * scale)


def _coloured(make: Callable[[str, float], BodySpec], colour: Colour) -> Callable[[str, float], BodySpec]:
    """Return what makes the same things in another colour."""
    return lambda name, scale: replace(make(name, scale), colour=colour)
