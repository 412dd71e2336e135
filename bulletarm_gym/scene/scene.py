"""What tasks, controls and planners share: the bodies by role, the arm, the surface and the workspace."""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import MAX_ROTATION, MAX_TRANSLATION, ORTHOGRAPHIC, EnvConfig
from bulletarm_gym.geometry import FloatArray, Pose, Vector, matrix
from bulletarm_gym.rendering.mesh_poses import MeshPoses
from bulletarm_gym.rendering.point_cloud import project
from bulletarm_gym.rendering.rasterizer import Labels
from bulletarm_gym.rendering.z_buffer import ZBuffer
from bulletarm_gym.robots import Robot, RobotModel
from bulletarm_gym.scene.stability import is_stable
from bulletarm_gym.scene.stopwatch import PHYSICS, RENDERING, Stopwatch
from bulletarm_gym.simulation import Body, BodySpec, Camera, World
from bulletarm_gym.simulation.physics import PHYSICS_MODES, REST_SPEED
from bulletarm_gym.simulation.properties import Properties
from bulletarm_gym.simulation.settling import CREEP_SPEED, settle
from bulletarm_gym.simulation.shapes import Colour
from bulletarm_gym.simulation.state import STILL, Twist
from bulletarm_gym.surfaces import Surface

T = TypeVar("T")

SIDE_DISTANCE = 0.5
"""Where the side cameras stand beside the workspace's centre (m) ..."""
SIDE_HEIGHT = 1.0
"""... how high (m) ..."""
SIDE_FOV = 35.6
"""... their field of view (degrees) ..."""
SIDE_PIXELS = 512
"""... and their resolution."""
SIDE_WORKSPACE = 0.4
"""Side (m) of the largest workspace that they show from there; for a larger one they are farther away."""
SETTLE_LIMIT = 240
"""Most simulation steps (1 s) that loose bodies are given to come to rest."""
MOST_VARIANTS = 120
"""Bodies that are loaded to play all roles where sizes are drawn: Bullet looks at every pair of them in every
step, parked or not. Twice as many as any task has without."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Steps of this share go round a circle most evenly, however many are made."""


@dataclass(frozen=True)
class ObjectSlot:
    """A part that a body plays in a task, and the bodies that may play it.

    :param variants: of different sizes or shapes; one is drawn each episode. Of several sizes the smallest
        comes first, each in all shapes, in the same order
    :param kind: what it has in common with other roles of the task: its kind of block, its colour
    """

    name: str
    variants: tuple[BodySpec, ...]
    kind: str = ""


def scaled(
    config: EnvConfig, name: str, make: Callable[[str, float], BodySpec], kind: str = ""
) -> ObjectSlot:
    """Return a role played by one body a size: ``make(name, scale)`` for every scale of the configuration."""
    return ObjectSlot(name, tuple(make(f"{name} {scale:g}", scale) for scale in config.scales), kind)


def shaped(
    config: EnvConfig, name: str, make: Callable[[str, float, int], BodySpec], shapes: int
) -> ObjectSlot:
    """Return a role played by ``make(name, scale, number)`` for every scale and all of so many shapes."""
    kinds = [(scale, kind) for scale in config.scales for kind in range(shapes)]
    return ObjectSlot(name, tuple(make(f"{name} {kind} {scale:g}", scale, kind) for scale, kind in kinds))


def spread(roles: Sequence[ObjectSlot], most: int) -> list[list[int]]:
    """Choose variants of roles so that all together are at most so many, but one a role at least.

    Roles of few variants keep all; the others keep as many as each other, spread evenly over shapes and
    sizes: one role goes on where the one before it ended, so that together they have as many different ones
    as can be.

    :param most: variants
    :return: for each role the places of its chosen variants, in their order
    """
    counts = [len(role.variants) for role in roles]
    most_of_one = max(counts, default=1)
    while most_of_one > 1 and sum(min(count, most_of_one) for count in counts) > most:
        most_of_one -= 1
    chosen, first = [], 0
    for count in counts:
        if count <= most_of_one:
            chosen.append(list(range(count)))
            continue
        # What has no divisor in common with the number of variants has none with that of the shapes, so that
        # these come in turn, too.
        step = next(s for s in range(round(GOLDEN * count), count) if math.gcd(s, count) == 1)
        chosen.append(sorted((first + number) * step % count for number in range(most_of_one)))
        first += most_of_one
    return chosen


class SceneObject:
    """The body that plays a role in this episode.

    :param role: which
    :param choices: places of the role's variants that can be drawn
    :param world: where their bodies are loaded
    :param pad_width: width (m) of the pads of the robot's fingers
    """

    def __init__(self, role: ObjectSlot, choices: Sequence[int], world: World, pad_width: float) -> None:
        self.role = role
        self.pad_width = pad_width
        self.choices = choices
        self.variant = 0
        self._bodies = [world.add(role.variants[place]) for place in choices]
        self._world = world
        self._of_shapes: list[dict[Any, Any]] = [{} for _ in choices]
        self._of_pose: tuple[int, Pose, dict[Any, Any]] = (-1, Pose((0.0, 0.0, 0.0)), {})

    @property
    def body(self) -> Body:
        """The body in the world."""
        return self._bodies[self.variant]

    @property
    def bodies(self) -> list[Body]:
        """All bodies that may play the role."""
        return list(self._bodies)

    @property
    def spec(self) -> BodySpec:
        """What the body is made of."""
        return self.body.spec

    @property
    def pose(self) -> Pose:
        """The body's pose in the world."""
        return self._world.poses[self.body.index]

    @property
    def lowest(self) -> float:
        """Height (m) of the body's lowest point."""
        return self.cached_by_pose(_lowest)

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the body's true bounding box in the world, (2, 3) m."""
        vertices = self.spec.mesh.vertices @ matrix(self.pose).T + self.pose.position
        return np.stack([vertices.min(axis=0), vertices.max(axis=0)])

    @property
    def centre_of_mass(self) -> Vector:
        """Where (m) the body's centre of mass is in the world."""
        return self.pose.transform(self.spec.mass_properties[0].position)

    def cached_by_shape(self, compute: Callable[["SceneObject"], T]) -> T:
        """Return what a function tells from the body's shape alone, computed once."""
        known = self._of_shapes[self.variant]
        if compute not in known:
            known[compute] = compute(self)
        found: T = known[compute]
        return found

    def cached_by_pose(self, compute: Callable[["SceneObject"], T]) -> T:
        """Return what a function tells from the body's shape and pose alone, computed once for each pose."""
        pose = self.pose
        variant, before, known = self._of_pose
        if variant != self.variant or pose != before:
            known = {}
            self._of_pose = (self.variant, pose, known)
        if compute not in known:
            known[compute] = compute(self)
        found: T = known[compute]
        return found

    @property
    def is_present(self) -> bool:
        """Whether the body takes part at present."""
        return self._world.active[self.body.index]

    def place(self, pose: Pose, twist: Twist = STILL) -> None:
        """Put the body somewhere, at rest or with a linear (m/s) and an angular (rad/s) velocity."""
        self._world.place(self.body, pose, twist)

    @property
    def properties(self) -> Properties:
        """Mass, frictions, restitution and colour that are in effect."""
        return self._world.get_properties(self.body)

    def set_properties(self, **changes: Any) -> None:
        """Change properties of the body until the next reset; an omitted one stays as it is.

        :param changes: fields of :class:`~bulletarm_gym.simulation.properties.Properties`
        :raises ValueError: one of them is out of range
        :raises TypeError: an unknown property
        """
        self._world.set_properties(self.body, self.properties.changed(**changes))

    @property
    def joints(self) -> tuple[float, ...]:
        """Positions (m or rad) of the body's parts that slide or turn."""
        return self._world.joints[self.body.index]

    def set_joints(self, positions: Sequence[float]) -> None:
        """Put the body's parts somewhere (m or rad), at rest."""
        self._world.set_joints(self.body, positions)

    def park(self) -> None:
        """Take every body of the role out of the scene."""
        for body in self._bodies:
            if self._world.active[body.index]:
                self._world.park(body)


def _lowest(item: SceneObject) -> float:
    heights = item.spec.mesh.vertices @ matrix(item.pose)[2]
    return item.pose.z + float(heights.min())


class Scene:
    """One workspace with everything in it; loaded once, arranged anew each episode.

    :param config: the environment's parameters
    :param model: the arm
    :param surface: the ground
    :param roles: every body the task will ever need; where sizes are drawn, at most :data:`MOST_VARIANTS`
    """

    def __init__(
        self, config: EnvConfig, model: RobotModel, surface: Surface, roles: Sequence[ObjectSlot]
    ) -> None:
        self.config = config
        self.surface = surface
        # Limits of a close-loop action (m, rad): those of the control, once the experts' tracker exists.
        self.max_translation, self.max_rotation = MAX_TRANSLATION, MAX_ROTATION
        self.world = World(PHYSICS_MODES[config.physics_mode], gui=config.render_mode == "human")
        surface.load(self.world)
        self.robot = Robot(model, self.world, config.fast_mode)
        choices = spread(roles, MOST_VARIANTS) if len(config.scales) > 1 else spread(roles, sys.maxsize)
        self._items = {
            role.name: SceneObject(role, places, self.world, model.gripper.finger[1])
            for role, places in zip(roles, choices, strict=True)
        }
        self.world.seal()

    def __getitem__(self, name: str) -> SceneObject:
        """Return the item of a role."""
        return self._items[name]

    def __iter__(self) -> Iterator[SceneObject]:
        """Iterate over the items that take part."""
        return (item for item in self._items.values() if item.is_present)

    @property
    def objects(self) -> list[SceneObject]:
        """The items of all roles, in their order, absent ones too."""
        return list(self._items.values())

    @property
    def held(self) -> SceneObject | None:
        """The item in the gripper."""
        held = self.robot.held
        return None if held is None else next((item for item in self if item.body is held), None)

    def clear(self, rng: np.random.Generator) -> None:
        """Empty the scene, draw its ground and who plays each role."""
        self.world.unsettled.update(body.index for body in self.world.loose_bodies)
        self.world.reset_properties()
        self.surface.arrange(rng)
        for item in self._items.values():
            item.park()
            item.variant = int(rng.integers(len(item.choices)))

    def begin(self) -> None:
        """Start a move from the canonical world."""
        self.robot.begin()

    def settle(self) -> None:
        """Simulate until all loose bodies rest, if one of them moves, was placed or lost its support."""
        world, held = self.world, self.robot.held
        loose = [body for body in world.loose_bodies if body is not held]
        speeds = {body.index: world.speed(body) for body in loose}
        doubtful = [
            body for body in loose if body.index in world.unsettled or speeds[body.index] >= CREEP_SPEED
        ]
        slow = max(speeds.values(), default=0.0) < REST_SPEED
        if doubtful and not (slow and self._lie_still(doubtful)):
            settle(world, loose, SETTLE_LIMIT)
        world.unsettled.clear()
        self.robot.resolve_penetration()

    def _lie_still(self, bodies: Sequence[Body]) -> bool:
        return is_stable(self.world, self.surface, bodies) and not self.robot.touched(bodies)

    def measure(self) -> Stopwatch:
        """Return a stopwatch to which the engine's steps and heightmaps report from now on."""
        stopwatch = Stopwatch()
        self.world.client.replace("stepSimulation", partial(stopwatch.timed, PHYSICS))
        self._draw = stopwatch.timed(RENDERING, self._draw)
        self._label = stopwatch.timed(RENDERING, self._label)
        return stopwatch

    def get_variants(self) -> tuple[int, ...]:
        """Return which of an item's choices plays each role."""
        return tuple(item.variant for item in self._items.values())

    def set_variants(self, variants: Sequence[int]) -> None:
        """Return to a cast; the bodies are the world's."""
        for item, variant in zip(self._items.values(), variants, strict=True):
            item.variant = variant

    # What is seen of it

    def heights(
        self, centre: tuple[float, float], extent: float, size: int, without: Body | None = None
    ) -> NDArray[np.float32]:
        """Return the height (m) of the highest surface over each pixel of a square; the arm is not seen.

        :param centre: world x and y of the middle of the square (m)
        :param extent: its side (m)
        :param size: pixels a side
        :param without: a body that is not drawn
        :return: (size, size); rows grow with world x, columns with y
        """
        if self.config.view == ORTHOGRAPHIC:
            seen = self._without(self._meshes.present & ~self._marks, without)
            return self._draw(*self._meshes.poses(), seen, centre, extent, size)
        clouds = [camera.points(self.world, [self.robot.body]) for camera in self.side_cameras(SIDE_PIXELS)]
        return project(np.concatenate(clouds), centre, extent, size, self.config.workspace[2][1])

    def labelled(
        self, centre: tuple[float, float], extent: float, size: int, without: Body | None = None
    ) -> tuple[NDArray[np.float32], Labels]:
        """Return the heights, as :meth:`heights` looking straight down, and which part is seen at each pixel.

        The parameters are those of :meth:`heights`.

        :return: (size, size) float32, m; (size, size) int16, 0 where the endless ground is seen, else 1 and
            the place in :attr:`parts`. Marks on the ground have no height, but are seen
        """
        seen = self._without(self._meshes.present, without)
        return self._label(*self._meshes.poses(), seen, self._marks, centre, extent, size)

    def heights_of(
        self, bodies: Sequence[Body], centre: tuple[float, float], extent: float, size: int
    ) -> NDArray[np.float32]:
        """Return the height (m) of the highest surface of some bodies alone, seen straight from above.

        The parameters are those of :meth:`heights`; where there is none of them the height is 0.
        """
        seen = self._meshes.present & self._meshes.of(bodies)
        return self._draw(*self._meshes.poses(), seen, centre, extent, size)

    @cached_property
    def _meshes(self) -> MeshPoses:
        return MeshPoses(self.world)

    @cached_property
    def parts(self) -> list[tuple[Body, Colour]]:
        """What is seen from above: each body and each of its sliding parts, with its colour."""
        return [(body, colour) for body in self.world.visible for colour in body.spec.part_colours]

    @property
    def colours(self) -> list[Colour]:
        """Colours of :attr:`parts` that are in effect: a task may have changed those of bodies."""
        return [
            colour
            for body in self.world.visible
            for colour in (self.world.get_properties(body).colour, *body.spec.part_colours[1:])
        ]

    @cached_property
    def _z_buffer(self) -> ZBuffer:
        return ZBuffer([mesh for body in self.world.visible for mesh in body.spec.part_meshes])

    @cached_property
    def _draw(self) -> Callable[..., NDArray[np.float32]]:
        return self._z_buffer.heights

    @cached_property
    def _label(self) -> Callable[..., tuple[NDArray[np.float32], Labels]]:
        return self._z_buffer.labelled

    @cached_property
    def _marks(self) -> NDArray[np.bool_]:
        return np.array([body.spec.is_mark for body, _ in self.parts], np.bool_)

    def _without(self, seen: NDArray[np.bool_], body: Body | None) -> NDArray[np.bool_]:
        return seen if body is None else seen & [other is not body for other, _ in self.parts]

    def side_cameras(self, pixels: int) -> tuple[Camera, Camera]:
        """Return the two cameras at the workspace's sides (paper, Close-loop Environments).

        :param pixels: a side of their images
        """
        x, y = self.config.centre
        scale = max(1.0, self.config.workspace_size / SIDE_WORKSPACE)
        eyes = [(x, y + side * scale, SIDE_HEIGHT * scale) for side in (-SIDE_DISTANCE, SIDE_DISTANCE)]
        first, second = (Camera(eye, (x, y, 0.0), SIDE_FOV, pixels, pixels, 0.1, 3.0 * scale) for eye in eyes)
        return first, second
