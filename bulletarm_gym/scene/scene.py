"""Scene of a task: its surface, robot and objects."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from bulletarm_gym.config import MAX_ROTATION, MAX_TRANSLATION, EnvConfig
from bulletarm_gym.config_checks import ROUNDING, check_argument, check_fields, instances, numbers, rule
from bulletarm_gym.geometry import FloatArray, Pose, Vector, matrix
from bulletarm_gym.geometry.poses import pose_check
from bulletarm_gym.robots import Robot, RobotModel
from bulletarm_gym.scene.stability import CREEP_SPEED, is_stable, settle
from bulletarm_gym.simulation import Body, BodySpec, World
from bulletarm_gym.simulation.motion import set_resistance_factor
from bulletarm_gym.simulation.state import PHYSICS_MODES, REST_SPEED, STILL, Optics, Properties, Twist
from bulletarm_gym.surfaces import Surface

T = TypeVar("T")

SETTLE_LIMIT = 240
"""Maximum number of simulation steps (1 s) for loose bodies to come to rest."""
MAX_BODIES = 120
"""Maximum number of loaded variants if sizes are sampled; every step costs time for each pair of bodies."""
TWIST = rule(
    "a pair of a linear (m/s) and an angular velocity (rad/s), (x, y, z) each",
    lambda pair: len(pair) == 2,
    lambda pair: tuple(map(numbers(count=3), pair)),
)
"""Check of velocities."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Golden ratio, whose multiples are spread evenly over the unit interval modulo 1."""


@dataclass(frozen=True)
class ObjectSlot:
    """Slot of a task for one object, and the bodies that can fill it.

    :param variants: bodies of different sizes or shapes, of which one is sampled at every reset; the smallest
        size first, each size in all shapes, in the same order
    :param kind: property that slots of a task share: the kind of block, the colour
    :param scales: scale of each variant; empty if the object has one size
    :param like: name of an earlier slot with the same number of variants. Both always have the same variant,
        such as a peg and its socket
    """

    name: str
    variants: tuple[BodySpec, ...]
    kind: str = ""
    scales: tuple[float, ...] = ()
    like: str = ""

    def __post_init__(self) -> None:
        check_fields(
            self, {"variants": instances(BodySpec, "bodies", can_be_empty=False)}, f" of {self.name!r}"
        )


def scaled(
    config: EnvConfig, name: str, make: Callable[[str, float], BodySpec], kind: str = "", like: str = ""
) -> ObjectSlot:
    """Return a slot with one variant, ``make(name, scale)``, for every scale of the configuration.

    :param like: name of an earlier slot that has the same scale
    """
    scales = tuple(config.scales)
    return ObjectSlot(name, tuple(make(f"{name} {scale:g}", scale) for scale in scales), kind, scales, like)


def shaped(
    config: EnvConfig, name: str, make: Callable[[str, float, int], BodySpec], shapes: int
) -> ObjectSlot:
    """Return a slot with the variants ``make(name, scale, number)`` for every scale and number of a shape."""
    kinds = [(scale, kind) for scale in config.scales for kind in range(shapes)]
    variants = tuple(make(f"{name} {kind} {scale:g}", scale, kind) for scale, kind in kinds)
    return ObjectSlot(name, variants, scales=tuple(scale for scale, _ in kinds))


def subsample_variants(slots: Sequence[ObjectSlot], limit: int) -> list[list[int]]:
    """Return the sorted indices of the chosen variants of each slot, at most ``limit`` if slots permit.

    Slots with few variants keep all. The others keep the same number, spread evenly over shapes and sizes. A
    slot continues where the previous one ended, so that together they keep many different variants.
    """
    counts = [len(slot.variants) for slot in slots]
    kept = max(counts, default=1)
    while kept > 1 and sum(min(count, kept) for count in counts) > limit:
        kept -= 1
    chosen, first = [], 0
    for count in counts:
        if count <= kept:
            chosen.append(list(range(count)))
            continue
        # A step coprime to the number of variants is coprime to that of shapes, so that these alternate.
        step = next(s for s in range(round(GOLDEN * count), count) if math.gcd(s, count) == 1)
        chosen.append(sorted((first + number) * step % count for number in range(kept)))
        first += kept
    return chosen


def cached_by_pose(compute: Callable[["SceneObject"], T]) -> Callable[["SceneObject"], T]:
    """Return a function of an object's shape and pose alone that is computed once for each pose."""

    @wraps(compute)
    def cached(obj: "SceneObject") -> T:
        return obj.cached(compute, (obj.variant, obj.pose))

    return cached


class SceneObject:
    """The object in a slot.

    :param slot: its slot
    :param choices: indices of the slot's variants that are loaded
    :param world: world that their bodies are loaded into
    :param pad_width: width (m) of the pads of the robot's fingers
    """

    def __init__(self, slot: ObjectSlot, choices: Sequence[int], world: World, pad_width: float) -> None:
        self.slot = slot
        self.pad_width = pad_width
        self.choices = choices
        self.variant = 0
        self.bodies: list[Body] = [world.add(slot.variants[index]) for index in choices]
        """Bodies of all loaded variants."""
        self._world = world
        self._cache: dict[Any, tuple[Any, Any]] = {}

    @property
    def body(self) -> Body:
        """Body of the present variant."""
        return self.bodies[self.variant]

    @property
    def spec(self) -> BodySpec:
        """Specification of the body."""
        return self.body.spec

    def fitting(self, low: float, high: float) -> list[int]:
        """Return the numbers of the loaded variants with scales in a range, or all without scales."""
        scales = self.slot.scales
        low, high = low - ROUNDING, high + ROUNDING
        return [n for n, index in enumerate(self.choices) if not scales or low <= scales[index] <= high]

    @property
    def pose(self) -> Pose:
        """Pose of the body in the world."""
        return self._world.poses[self.body.index]

    @property
    @cached_by_pose
    def lowest(self) -> float:
        """Height (m) of the body's lowest point."""
        return self.pose.z + float((self.spec.mesh.vertices @ matrix(self.pose)[2]).min())

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the body's true bounding box in the world, (2, 3) m."""
        vertices = self.spec.mesh.vertices @ matrix(self.pose).T + self.pose.position
        return np.stack([vertices.min(axis=0), vertices.max(axis=0)])

    @property
    def centre_of_mass(self) -> Vector:
        """Position (m) of the body's centre of mass in the world."""
        return self.pose.transform(self.spec.mass_properties[0].position)

    def cached(self, compute: Callable[["SceneObject"], T], key: Any) -> T:
        """Return the value of a function of the object, computed once until ``key`` changes."""
        if self._cache.get(compute, (None, None))[0] != key:
            self._cache[compute] = (key, compute(self))
        value: T = self._cache[compute][1]
        return value

    @property
    def is_present(self) -> bool:
        """Return True if the body is in the scene."""
        return self._world.active[self.body.index]

    def place(self, pose: Pose, twist: Twist = STILL) -> None:
        """Set the body's pose, at rest or with a linear (m/s) and an angular (rad/s) velocity."""
        pose, twist = check_argument("pose", pose, pose_check), check_argument("twist", twist, TWIST)
        self._world.place(self.body, pose, twist)

    @property
    def properties(self) -> Properties:
        """Present mass, frictions, restitution and colour."""
        return self._world.get_properties(self.body)

    def set_properties(self, **changes: Any) -> None:
        """Change properties of the body until the next reset; an omitted one stays as it is.

        :param changes: fields of :class:`~bulletarm_gym.simulation.state.Properties`
        :raises ValueError: one of them is out of range
        :raises TypeError: an unknown property
        """
        self._world.set_properties(self.body, replace(self.properties, **changes))

    @property
    def joints(self) -> tuple[float, ...]:
        """Positions (m or rad) of the body's joints."""
        return self._world.joints[self.body.index]

    def set_joints(self, positions: Sequence[float]) -> None:
        """Set the positions (m or rad) of the body's joints, at rest."""
        check = numbers(count=len(self.body.joints))
        self._world.set_joints(self.body, check_argument("positions", positions, check))

    def park(self) -> None:
        """Remove the body from the scene."""
        if self.is_present:
            self._world.park(self.body)


class Scene:
    """Scene of a task; its bodies are loaded once and arranged at every reset.

    :param config: the environment's parameters
    :param model: the arm
    :param surface: the surface
    :param slots: slots of all objects of the task; if sizes are sampled, at most :data:`MAX_BODIES` variants
        are loaded
    """

    def __init__(
        self, config: EnvConfig, model: RobotModel, surface: Surface, slots: Sequence[ObjectSlot]
    ) -> None:
        self.config = config
        self.surface = surface
        # Limits (m, rad) of a closed-loop action; the experts' tracker replaces them by the control's.
        self.max_translation, self.max_rotation = MAX_TRANSLATION, MAX_ROTATION
        self.world = World(PHYSICS_MODES[config.physics_mode], gui=config.render_mode == "human")
        surface.load(self.world)
        self.robot = Robot(model, self.world, config.fast_mode)
        indices = subsample_variants(slots, MAX_BODIES if len(config.scales) > 1 else sys.maxsize)
        choices = {slot.name: chosen for slot, chosen in zip(slots, indices, strict=True)}
        self._objects = {
            slot.name: SceneObject(slot, choices[slot.like or slot.name], self.world, model.gripper.finger[1])
            for slot in slots
        }
        self.world.seal()
        self._cache: dict[Any, Any] = {}
        self.sampled: Mapping[str, float] = {}
        """Sampled values of the episode by key, see :class:`~bulletarm_gym.randomization.Randomization`."""
        self.narrow(config.object_scale_range, slots)

    def __getitem__(self, name: str) -> SceneObject:
        """Return the object in a slot."""
        return self._objects[name]

    def __iter__(self) -> Iterator[SceneObject]:
        """Iterate over the objects in the scene."""
        return (obj for obj in self._objects.values() if obj.is_present)

    @property
    def objects(self) -> list[SceneObject]:
        """Objects of the slots that the episode uses, in their order, absent ones included."""
        return list(self._used)

    @property
    def all_objects(self) -> list[SceneObject]:
        """Objects of all slots, also of those that an episode with fewer objects does not use."""
        return list(self._objects.values())

    @property
    def held(self) -> SceneObject | None:
        """The grasped object."""
        held = self.robot.held
        return None if held is None else next((obj for obj in self if obj.body is held), None)

    def cached(self, compute: Callable[["Scene"], T]) -> T:
        """Return the value of a function of the loaded bodies alone, computed once."""
        if compute not in self._cache:
            self._cache[compute] = compute(self)
        value: T = self._cache[compute]
        return value

    def clear(self, rng: np.random.Generator) -> None:
        """Remove all objects; sample the surface and the variants of the slots."""
        self.world.unsettled.update(body.index for body in self.world.loose_bodies)
        self.world.reset_properties()
        self.surface.arrange(rng)
        for name, obj in self._objects.items():
            obj.park()
            fitting, like = self._fitting[name], obj.slot.like
            obj.variant = self[like].variant if like else fitting[int(rng.integers(len(fitting)))]

    def narrow(self, scale_range: Sequence[float], slots: Sequence[ObjectSlot]) -> None:
        """Set the scales and the slots that the following episodes use.

        :param scale_range: lowest and highest scale
        :param slots: slots of the task, which may be fewer than the loaded ones of each name or kind
        """
        kinds = [slot.kind or slot.name for slot in slots]
        self._used = []
        for obj in self._objects.values():
            if (kind := obj.slot.kind or obj.slot.name) in kinds:
                kinds.remove(kind)
                self._used.append(obj)
        self._fitting = {name: obj.fitting(*scale_range) for name, obj in self._objects.items()}

    def set_surface_properties(self, **changes: Any) -> None:
        """Change properties of all bodies of the surface until the next reset.

        :param changes: fields of :class:`~bulletarm_gym.simulation.state.Properties`
        :raises ValueError: one of them is out of range
        """
        for body in self.surface.bodies:
            self.world.set_properties(body, replace(self.world.get_properties(body), **changes))

    def set_sampled(self, values: Mapping[str, float]) -> None:
        """Set the sampled values of an episode; :meth:`randomize` changes the properties of bodies."""
        if values == self.sampled:
            return
        self.sampled = values
        self.robot.set_force_factor(values.get("gripper_force", 1.0))
        set_resistance_factor(self.world, values.get("joint_resistance", 1.0))
        names = ("camera_position", "camera_rotation", "light_direction")
        position, rotation, light = (
            tuple(values.get(f"{name}_{axis}", 0.0) for axis in "xyz") for name in names
        )
        self.world.optics = Optics(position, rotation, light, values.get("light_brightness", 1.0))

    def randomize(self, rng: np.random.Generator) -> None:
        """Change the properties of all bodies by the sampled values; each body has a colour of its own."""
        values, world = self.sampled, self.world
        kinds = {"object": [obj.body for obj in self.all_objects], "surface": self.surface.bodies}
        for kind, body in ((kind, body) for kind, bodies in kinds.items() for body in bodies):
            before = world.get_properties(body)
            shift = values.get("colour", 0.0) * rng.uniform(-1.0, 1.0, 3)
            colour = (*(before.colour[:3] + shift).clip(0.0, 1.0), before.colour[3])
            mass = values.get(f"{kind}_mass", 1.0) * before.mass
            friction = values.get(f"{kind}_friction", 1.0) * before.friction
            world.set_properties(body, replace(before, mass=mass, friction=friction, colour=colour))

    def begin(self) -> None:
        """Start a move from the canonical world."""
        self.robot.begin()

    def settle(self) -> None:
        """Simulate until loose bodies are at rest, if one of them moves, was placed or lost its support."""
        world, robot = self.world, self.robot
        loose = [body for body in world.loose_bodies if body is not robot.held]
        slow = all(world.speed(body) < REST_SPEED for body in loose)
        doubtful = [b for b in loose if b.index in world.unsettled or world.speed(b) >= CREEP_SPEED]
        stable = slow and is_stable(world, self.surface, doubtful) and not robot.touched(doubtful)
        if doubtful and not stable:
            settle(world, loose, SETTLE_LIMIT)
        world.unsettled.clear()
        robot.resolve_penetration()
