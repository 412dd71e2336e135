"""Grasping one object after another out of a clutter."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bulletarm_gym.config import (
    CLOSE_LOOP,
    MAX_ROTATION,
    MAX_TRANSLATION,
    OPEN_LOOP,
    EnvConfig,
    TaskDefaults,
    TrayUse,
)
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts.approach import ALIGNED, ALIGNED_YAW, HOVER
from bulletarm_gym.experts.grasps import DEPTHS, YAWS, ElevationLayers, Grasps, find_grasps
from bulletarm_gym.experts.singulation import stir
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import (
    IDENTITY,
    FloatArray,
    Mesh,
    PlacementError,
    Pose,
    Quaternion,
    planar_distance,
    wrap_angle,
)
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.objects.sets import object_set
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject
from bulletarm_gym.scene.sampling import ARRANGEMENTS
from bulletarm_gym.simulation import BodySpec, Convex, Piece
from bulletarm_gym.simulation.settling import settle
from bulletarm_gym.tasks.task import Task

MOST_OBJECTS = 15
"""As many as the paper's open-loop clutter."""
DROP_HEIGHT = 0.12
"""Height (m) above the tray's floor from which objects are dropped."""
DROP_STEPS = 36
"""Simulation steps an object falls before the next one: as long as it takes down to the floor."""
DROP_MARGIN = 0.055
"""Distance (m) that objects are dropped within the workspace's border, and so from the tray's walls."""
SETTLE_STEPS = 480
"""Most simulation steps (2 s) that a new clutter is given to come to rest."""
ARM_AWAY = 0.4
"""Height (m) of the fingertips while objects are dropped, if the robot reaches it."""
NUMBERS = tuple(range(1, MOST_OBJECTS + 1))
IN_TRAY = TrayUse((True,), "without it the objects would roll out of the workspace")

FLOOR_CLEARANCE = 0.004
"""Least height (m) of the fingertips above the tray's floor."""
PITCH = 0.003
"""Side (m) of the pixels that grasps are searched in."""
SURROUNDINGS = 0.05
"""How far (m) beyond the workspace is looked: an open gripper reaches there."""
TURN_WORTH = 1.5 * MAX_TRANSLATION / MAX_ROTATION
"""The way (m/rad) that a turn is worth: more than what takes as many actions, for turns are hard to learn."""
WAY_WEIGHT = 6.0
"""What a metre of way costs of a grasp's quality: so much that the nearest is meant, which one can see."""
FUNNEL = 0.03
"""Distance (m) within which the gripper comes down to a grasp, lower the nearer it is."""
FUNNEL_TURN = 0.04
"""The distance (m/rad) that a turn is worth there."""
DEEP = 0.025
"""Nearer (m) above a grasp than this, the fingers close at the end of the same step."""
SHUT = 0.7
"""Opening ratio below which the gripper has to open before it comes down."""
SAME_PLACE = 0.02
"""A gripper still as near (m) as this to where it failed has not tried again."""
NEAR_FAILURE = 0.02
"""Grasps this near (m) to one that failed ..."""
FAILURE_COST = 0.25
"""... are worth less by this, twice where they are turned alike ..."""
ALIKE = 0.3
"""... within this angle (rad)."""
MOST_FAILURES = 6
"""Failures remembered."""

PICK_DEPTH = 0.025
"""How far (m) below the highest point between the fingers open loop grasps, where the action does not say."""
PICK_AREA = (0.07, 0.02)
"""Length and width (m) of what counts as between the fingers then."""
NUDGE = 0.04
"""Greatest distance (m), along x and along y, at which the fingers close beside an object to move it."""
CHANCE = 0.02
"""Standard deviation of what chance adds to a grasp's quality."""


class ObjectGrasping(Task):
    """Grasp any object of a clutter and lift it.

    Description: a tray with up to N of 86 objects.
    Randomisation: at the start N objects of the set are dropped into the tray one by one, each in a random
    pose; with ``random_orientation=False`` each lies flat along y. What an episode leaves in the tray stays
    for the next; when all are grasped, or the scene has become invalid, N others are drawn.
    Success: the gripper holds an object and is higher than ``lift_height``, 15 cm. The object is taken away
    when the next episode begins.
    Expert: the nearest of the good grasps from above that a search over heightmaps finds, straight up with
    it.
    """

    defaults = TaskDefaults(
        num_objects=5,
        allowed_objects=NUMBERS,
        tray=IN_TRAY,
        takes_object_set=True,
        lifts=True,
    )
    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """Up to where the gripper must lift."""
        return self.config.lift_height

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return all objects of the set, each in one size.

        :raises ValueError: the set has fewer than ``num_objects``, or is of kinds that there are not
        """
        specs, scales = object_set(config.object_set), config.scales
        if len(specs) < config.num_objects:
            raise ValueError(
                f"num_objects: got {config.num_objects}, takes at most {len(specs)} with this object_set"
            )
        return [
            ObjectSlot(spec.name, (resized(spec, scales[n % len(scales)]),)) for n, spec in enumerate(specs)
        ]

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return nothing: what is too large for the gripper is left where it is."""
        return []

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Drop objects into the tray.

        :raises PlacementError: they do not stay in it
        """
        for _ in range(ARRANGEMENTS):
            chosen = rng.choice(len(scene.objects), self.config.num_objects, replace=False)
            self.drop(scene, [scene.objects[index] for index in chosen], rng)
            if self.is_valid(scene):
                return
            scene.clear(rng)
        raise PlacementError(f"num_objects: {self.config.num_objects} objects do not stay in the tray")

    def drop(self, scene: Scene, items: Sequence[SceneObject], rng: np.random.Generator) -> None:
        """Drop items into the tray one by one and let them come to rest, the arm out of their way."""
        start = scene.robot.pose
        away = Pose.planar(start.x, start.y, ARM_AWAY)
        scene.robot.home(away if scene.robot.reaches(away) else start)
        for item in items:
            item.place(self._drop_pose(scene, rng))
            scene.begin()
            scene.world.step(DROP_STEPS)
            scene.world.end()
        scene.begin()
        settle(scene.world, scene.world.loose_bodies, SETTLE_STEPS)
        scene.robot.home(start)

    def _drop_pose(self, scene: Scene, rng: np.random.Generator) -> Pose:
        point = scene.surface.sample_position(rng, DROP_MARGIN)
        orientation = random_orientation(rng)
        position = (*point, scene.surface.height(point) + DROP_HEIGHT)
        return Pose(position, orientation if self.config.random_orientation else IDENTITY)

    def continue_scene(self, scene: Scene, rng: np.random.Generator) -> bool:
        """Take the grasped object away and keep the others; false when none is left or one is outside."""
        held = scene.held
        if held is not None and scene.robot.pose.z > self.config.lift_height:
            held.park()
        return any(True for _ in scene) and self.is_valid(scene)

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        """Remember where the gripper closed and holds nothing."""
        hand, failed = scene.robot.pose, self._failed
        closed = scene.robot.get_state().opening < 0.5 * scene.robot.model.gripper.stroke
        known = (
            failed
            and planar_distance(failed[-1].position, hand.position) < SAME_PLACE
            and abs(wrap_angle(failed[-1].yaw - hand.yaw, math.pi)) < ALIKE
        )
        if closed and scene.robot.held is None and not known:
            self.memory = (*failed, hand)[-MOST_FAILURES:]

    @property
    def _failed(self) -> tuple[Pose, ...]:
        """Tool poses of this episode's failed grasps."""
        return self.memory or ()

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether anything is held, and how high."""
        held = scene.held is not None
        return {"success": held and scene.robot.pose.z > self.config.lift_height, "is_held": held}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp what is best to grasp, then lift; where nothing can be grasped, turn something."""
        hand = scene.robot.pose
        if scene.robot.held is None:
            relief = survey(scene)
            target = self._target(scene, relief)
            if target is None:
                yield from stir(scene, max(scene, key=lambda item: scene.world.top(item.body)), rng)
            else:
                yield _approach(scene, relief, target)
        else:
            height = max(hand.z, self.config.lift_height) + scene.max_translation
            yield Waypoint(Pose.planar(hand.x, hand.y, height, hand.yaw), CLOSED)

    def _target(self, scene: Scene, relief: ElevationLayers) -> Pose | None:
        """Return the grasp whose quality less the way to it is best, if any is good enough.

        The way shrinks as the gripper comes near, and for hardly any other grasp faster: the choice stands.
        """
        hand = scene.robot.pose
        grasps = self._grasps(scene, relief, DEPTHS)
        value = grasps.quality.copy()
        for failed in self._failed:
            near = np.hypot(grasps.x - failed.x, grasps.y - failed.y) < NEAR_FAILURE
            value -= FAILURE_COST * near * (1.0 + (np.abs(wrap(grasps.yaw - failed.yaw)) < ALIKE))
        good = value > 0.0
        if not good.any():
            return None
        turn = TURN_WORTH * wrap(grasps.yaw - hand.yaw)
        way = np.sqrt((grasps.x - hand.x) ** 2 + (grasps.y - hand.y) ** 2 + turn**2)
        return grasps.at(int(np.where(good, value - WAY_WEIGHT * way, -np.inf).argmax()))

    def _grasps(self, scene: Scene, relief: ElevationLayers, depths: Sequence[float]) -> Grasps:
        """Return the grasps within the workspace that have room, as :func:`find_grasps` does."""
        turns = "r" in self.config.action_sequence
        yaws = [math.pi * step / YAWS for step in range(YAWS)] if turns else [scene.robot.pose.yaw]
        lowest = max(scene.surface.level + FLOOR_CLEARANCE, self.config.workspace[2][0])
        grasps = find_grasps(relief, scene.robot.model.gripper, yaws, lowest, depths)
        return grasps.within(self.config.workspace[:2])


class OpenLoopObjectGrasping(ObjectGrasping):
    """Grasp any object of a clutter, by one pick.

    Description: a tray with up to N of the same 86 objects, by default 15.
    Success: the gripper holds an object when it has come back from the pick. The object is taken away when
    the next episode begins. Every action ends the episode.
    Expert: one of the best grasps from above; which of them is left to chance, for nothing may have changed
    since the last one failed.
    """

    defaults = TaskDefaults(
        num_objects=MOST_OBJECTS,
        max_steps=1,
        allowed_objects=NUMBERS,
        tray=IN_TRAY,
        takes_object_set=True,
    )
    controls = (OPEN_LOOP,)
    one_decision = True

    @property
    def height(self) -> float:
        """Above what lies in the tray; nothing need be lifted."""
        return CUBE_SIZE * max(self.config.scales)

    @property
    def grasp_params(self) -> GraspParams:
        """Grasps go deep; what is beside the fingers does not matter."""
        return GraspParams(pick_offset=PICK_DEPTH, pick_area=PICK_AREA)

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        """Remember nothing: the episode is over."""

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp what is best to grasp; where nothing can be grasped, stir up what lies highest."""
        if scene.held is not None:
            yield Waypoint(scene.robot.pose, CLOSED, finish=OPEN)
            return
        depths = DEPTHS if "z" in self.config.action_sequence else (PICK_DEPTH,)
        grasps = self._grasps(scene, survey(scene), depths)
        if len(grasps):
            value = grasps.quality + rng.normal(0.0, CHANCE, len(grasps))
            yield Waypoint(grasps.at(int(value.argmax())), OPEN, finish=CLOSED)
        else:
            yield Waypoint(self._beside(scene, rng), OPEN, finish=CLOSED)

    def _beside(self, scene: Scene, rng: np.random.Generator) -> Pose:
        """Draw a pose low beside an object's middle, from where the closing fingers move it inwards."""
        items = list(scene)
        item = items[rng.integers(len(items))]
        inward = np.subtract(self.config.centre, item.pose.position[:2])
        towards = math.atan2(inward[1], inward[0])
        inward *= rng.uniform(0.0, NUDGE) / max(float(np.hypot(*inward)), NUDGE)
        x, y = (item.pose.position[:2] + inward + rng.uniform(-NUDGE / 2.0, NUDGE / 2.0, 2)).tolist()
        yaw = towards if "r" in self.config.action_sequence else 0.0
        return Pose.planar(x, y, scene.surface.level + FLOOR_CLEARANCE, yaw)


def _approach(scene: Scene, relief: ElevationLayers, target: Pose) -> Waypoint:
    """Return what to do next for a grasp: open, always towards it, down a funnel, then close.

    But for opening and closing, a little more or less of anything changes what is done by no more than a
    little: who imitates it inexactly is led back.
    """
    hand, reach = scene.robot.pose, scene.robot.model.gripper.stroke / 2.0
    if scene.robot.opening_ratio < SHUT:
        top = relief.top_between(hand.position, hand.position, reach)
        return Waypoint(Pose.planar(hand.x, hand.y, max(hand.z, top) + HOVER, hand.yaw), OPEN)
    turn = wrap_angle(target.yaw - hand.yaw, math.pi)
    way = planar_distance(target.position, hand.position)
    if way < ALIGNED and abs(turn) < ALIGNED_YAW and abs(target.z - hand.z) < DEEP:
        return Waypoint(Pose.planar(target.x, target.y, target.z, hand.yaw + turn), OPEN, finish=CLOSED)
    # What will be left after this step; and not all the way down within a long one.
    dx, dy = (
        _beyond(goal - now, scene.max_translation) for goal, now in ((target.x, hand.x), (target.y, hand.y))
    )
    left = max(math.hypot(dx, dy), FUNNEL_TURN * _beyond(turn, scene.max_rotation))
    apart = max(left, max(way, FUNNEL_TURN * abs(turn)) / 2.0 - ALIGNED)
    top = max(target.z, relief.top_between(hand.position, target.position, reach) + HOVER)
    height = target.z + (top - target.z) * min(1.0, max(0.0, apart / FUNNEL))
    return Waypoint(Pose.planar(target.x, target.y, height, hand.yaw + turn), OPEN)


def _beyond(distance: float, limit: float) -> float:
    """Return by how much a distance exceeds a limit, either way."""
    return max(0.0, abs(distance) - limit)


def survey(scene: Scene) -> ElevationLayers:
    """Return the relief of the workspace."""
    centre, extent = scene.config.centre, scene.config.workspace_size + 2.0 * SURROUNDINGS
    size = round(extent / PITCH)
    items = list(scene)
    layers = [scene.heights_of([item.body], centre, extent, size) for item in items]
    own = {item.body.index for item in items}
    others = [body for body in scene.world.obstacles if body.index not in own]
    return ElevationLayers(np.stack(layers), scene.heights_of(others, centre, extent, size), centre, extent)


def wrap(angles: FloatArray) -> FloatArray:
    """Return angles (rad) in [-pi/2, pi/2): half a turn gives the gripper back."""
    return (angles + math.pi / 2.0) % math.pi - math.pi / 2.0


def random_orientation(rng: np.random.Generator) -> Quaternion:
    """Draw an orientation, all alike likely."""
    x, y, z, w = rng.standard_normal(4).tolist()
    norm = math.hypot(x, y, z, w)
    return (x / norm, y / norm, z / norm, w / norm)


def resized(spec: BodySpec, scale: float) -> BodySpec:
    """Return an object with all lengths times ``scale``."""
    if scale == 1.0:
        return spec
    meshes = [Mesh.of(piece.mesh.vertices * scale, piece.mesh.faces) for piece in spec.pieces]
    return replace(spec, pieces=tuple(Piece(Convex(mesh)) for mesh in meshes))
