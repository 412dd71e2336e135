"""Grasping objects in clutter, one after another."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import MAX_ROTATION, MAX_TRANSLATION, OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import ALIGNED, ALIGNED_YAW, HOVER, rotates
from bulletarm_gym.experts.grasp_sampling import DEPTHS, YAWS, ClutterMap, find_grasps
from bulletarm_gym.experts.pushing import singulate
from bulletarm_gym.geometry import FloatArray, PlacementError, Pose, planar_distance, wrap_angle
from bulletarm_gym.objects.catalogue import object_set
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject
from bulletarm_gym.scene.sampling import ARRANGEMENTS
from bulletarm_gym.scene.stability import settle
from bulletarm_gym.tasks.picking import Lift
from bulletarm_gym.tasks.task import Task

DROP_HEIGHT = 0.12
"""Height (m) above the tray's floor from which objects are dropped."""

DROP_MARGIN = 0.055
"""Distance (m) of dropped objects to the workspace's border and the tray's walls."""

DEFAULTS = TaskDefaults(
    num_objects=5,
    allowed_objects=tuple(range(1, 16)),
    needs_tray="without it the objects would roll out of the workspace",
    takes_object_set=True,
    lifts=True,
)

FLOOR_CLEARANCE = 0.004
"""Smallest height (m) of the fingertips above the tray's floor."""
ROTATION_WEIGHT = 1.5 * MAX_TRANSLATION / MAX_ROTATION
"""Distance (m/rad) equivalent to a rotation: more than that of the same number of actions, because agents
learn rotations less well."""
DISTANCE_COST = 6.0
"""Decrease of a grasp's quality per metre of distance, so that the nearest grasp wins, visible in images."""
FUNNEL = 0.03
"""Distance (m) within which the gripper descends to a grasp, gradually."""
FUNNEL_ROTATION = 0.04
"""Distance (m/rad) equivalent to a rotation within the funnel."""
DEEP = 0.025
"""Height (m) above a grasp within which the fingers close at the end of the step."""
SHUT = 0.7
"""Opening ratio below which the gripper opens before it descends."""
NEAR_FAILURE = 0.02
"""Distance (m) to a failed grasp within which a grasp is the same and loses quality."""
FAILURE_COST = 0.25
"""Decrease of the quality near a failed grasp, twice for a similar yaw."""
SAME_YAW = 0.3
"""Largest difference (rad) of similar yaws."""
MAX_FAILURES = 6
"""Number of failed grasps in the memory."""

PICK_DEPTH = 0.025
"""Depth (m) of open-loop grasps below the highest point between the fingers, for actions without z."""

NUDGE = 0.04
"""Largest distance (m) along x and y at which the fingers close next to an object to move it."""
QUALITY_NOISE = 0.02
"""Standard deviation of the noise on the quality of open-loop grasps."""


class ObjectGrasping(Lift):
    """Grasp any object of a clutter and lift it.

    Description: a tray with up to N of 86 objects.
    Randomisation: at the start N objects of the set are dropped into the tray one by one, each in a random
    pose; with ``random_orientation=False`` each lies flat along y. The next episode keeps the objects that
    remain in the tray. N others are sampled when all are grasped or the scene is invalid.
    Success: the gripper holds an object and is higher than ``lift_height``, 15 cm. The next episode removes
    that object.
    Expert: search an elevation map for grasps from above, execute the nearest good one, lift. Without a
    possible grasp, push the highest object.
    """

    instructions = ("Grasp any object{surface} and lift it.", "Pick up an object{surface}.")
    defaults = DEFAULTS
    grasps = False

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        specs = object_set(config.object_set)
        if len(specs) < config.num_objects:
            must = f"at most {len(specs)} with this object_set, got {config.num_objects}"
            raise ValueError(f"num_objects must be {must}")
        slots = []
        for spec, scale in zip(specs, cycle(config.scales), strict=False):
            pieces = tuple(piece.scaled(scale) for piece in spec.pieces)
            slots.append(ObjectSlot(spec.name, (replace(spec, pieces=pieces),), scales=(scale,)))
        return slots

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        for _ in range(ARRANGEMENTS):
            chosen = rng.choice(len(scene.objects), self.config.num_objects, replace=False)
            self.drop(scene, [scene.objects[index] for index in chosen], rng)
            if self.is_valid(scene):
                return
            scene.clear(rng)
        raise PlacementError(f"num_objects: {self.config.num_objects} objects do not stay in the tray")

    def drop(self, scene: Scene, objects: Sequence[SceneObject], rng: np.random.Generator) -> None:
        """Drop objects into the tray one by one and simulate until they rest (2 s), with the arm raised."""
        start = scene.robot.pose
        away = Pose.planar(start.x, start.y, 0.4)
        scene.robot.home(away if scene.robot.reaches(away) else start)
        for obj in objects:
            obj.place(self._drop_pose(scene, rng))
            scene.begin()
            scene.world.step(36)  # the duration of a fall to the floor
            scene.world.end()
        scene.begin()
        settle(scene.world, scene.world.loose_bodies, 480)
        scene.robot.home(start)

    def _drop_pose(self, scene: Scene, rng: np.random.Generator) -> Pose:
        point = scene.surface.sample_position(rng, DROP_MARGIN)
        x, y, z, w = rng.standard_normal(4).tolist()
        norm = math.hypot(x, y, z, w)
        position = (*point, scene.surface.height(point) + DROP_HEIGHT)
        if not self.config.random_orientation:
            return Pose(position)
        return Pose(position, (x / norm, y / norm, z / norm, w / norm))

    def continue_scene(self, scene: Scene, rng: np.random.Generator) -> bool:
        """Remove the lifted object and keep the others; return False if none is left or one is outside."""
        held = scene.held
        if held is not None and scene.robot.pose.z > self.config.lift_height:
            held.park()
        return any(True for _ in scene) and self.is_valid(scene)

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        """Remember the tool pose of a failed grasp."""
        tool, failed = scene.robot.pose, self.memory or ()
        closed = scene.robot.get_state().opening < 0.5 * scene.robot.model.gripper.stroke
        known = (
            failed
            and planar_distance(failed[-1].position, tool.position) < NEAR_FAILURE
            and abs(wrap_angle(failed[-1].yaw - tool.yaw, math.pi)) < SAME_YAW
        )
        if closed and scene.robot.held is None and not known:
            self.memory = (*failed, tool)[-MAX_FAILURES:]

    def plan_grasp(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        clutter = ClutterMap.of(scene)
        target = self._target(scene, clutter)
        if target is None:
            yield from singulate(scene, max(scene, key=lambda obj: scene.world.top(obj.body)), rng)
        else:
            yield _approach(scene, clutter, target)

    def _target(self, scene: Scene, clutter: ClutterMap) -> Pose | None:
        """Return the grasp with the best quality minus distance cost, if any grasp is good enough."""
        # The distance decreases fastest for the chosen grasp, so that the choice does not change.
        tool = scene.robot.pose
        grasps = self._grasps(scene, clutter, DEPTHS)
        x, y, _, yaw, quality = grasps.T
        value = quality.copy()
        for failed in self.memory or ():
            near = np.hypot(x - failed.x, y - failed.y) < NEAR_FAILURE
            value -= FAILURE_COST * near * (1.0 + (np.abs(_half_turns(yaw - failed.yaw)) < SAME_YAW))
        good = value > 0.0
        if not good.any():
            return None
        rotation = ROTATION_WEIGHT * _half_turns(yaw - tool.yaw)
        distance = np.sqrt((x - tool.x) ** 2 + (y - tool.y) ** 2 + rotation**2)
        best = int(np.where(good, value - DISTANCE_COST * distance, -np.inf).argmax())
        return Pose.planar(*grasps[best, :4].tolist())

    def _grasps(self, scene: Scene, clutter: ClutterMap, depths: Sequence[float]) -> FloatArray:
        """Return the grasps in the workspace, see :func:`find_grasps`."""
        yaws = [math.pi * step / YAWS for step in range(YAWS)] if rotates(scene) else [scene.robot.pose.yaw]
        limits: FloatArray = np.array(self.config.workspace)
        low, high = limits.T
        lowest = max(scene.surface.level + FLOOR_CLEARANCE, low[2])
        grasps = find_grasps(clutter, scene.robot.model.gripper, yaws, lowest, depths)
        inside: NDArray[np.bool_] = ((low[:2] < grasps[:, :2]) & (grasps[:, :2] < high[:2])).all(axis=1)
        return grasps[inside]


class OpenLoopObjectGrasping(ObjectGrasping):
    """Grasp any object of a clutter, by one pick.

    Description: a tray with up to N of the same 86 objects, by default 15.
    Success: the gripper holds an object after the pick. The next episode removes that object. Every action
    ends the episode.
    Expert: one of the best grasps from above. The choice is random, because the scene may be the same as
    before a failed grasp.
    """

    defaults = replace(DEFAULTS, num_objects=15, max_steps=1, lifts=False)
    controls = (OPEN_LOOP,)
    single_step = True
    after_action = Task.after_action  # the episode is over

    @property
    def grasp_params(self) -> GraspParams:
        return GraspParams(pick_offset=PICK_DEPTH, pick_area=(0.07, 0.02))  # the area between the fingers

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        if scene.held is not None:
            yield Waypoint(scene.robot.pose, CLOSED, finish=OPEN)
            return
        depths = DEPTHS if "z" in self.config.action_sequence else (PICK_DEPTH,)
        grasps = self._grasps(scene, ClutterMap.of(scene), depths)
        if len(grasps):
            value = grasps[:, 4] + rng.normal(0.0, QUALITY_NOISE, len(grasps))
            pose = Pose.planar(*grasps[int(value.argmax()), :4].tolist())
        else:
            pose = self._beside(scene, rng)
        yield Waypoint(pose, OPEN, finish=CLOSED)

    def _beside(self, scene: Scene, rng: np.random.Generator) -> Pose:
        """Sample a low pose next to an object's centre, from which the closing fingers move it inwards."""
        objects = list(scene)
        obj = objects[rng.integers(len(objects))]
        inward = np.subtract(self.config.centre, obj.pose.position[:2])
        yaw = math.atan2(inward[1], inward[0]) if rotates(scene) else 0.0
        inward *= rng.uniform(0.0, NUDGE) / max(float(np.hypot(*inward)), NUDGE)
        x, y = (obj.pose.position[:2] + inward + rng.uniform(-NUDGE / 2.0, NUDGE / 2.0, 2)).tolist()
        return Pose.planar(x, y, scene.surface.level + FLOOR_CLEARANCE, yaw)


def _approach(scene: Scene, clutter: ClutterMap, target: Pose) -> Waypoint:
    """Return the next waypoint of a grasp: open, move towards it, descend in a funnel, close."""
    tool, reach = scene.robot.pose, scene.robot.model.gripper.stroke / 2.0
    if scene.robot.opening_ratio < SHUT:
        top = clutter.top_between(tool.position, tool.position, reach)
        return Waypoint(Pose.planar(tool.x, tool.y, max(tool.z, top) + HOVER, tool.yaw), OPEN)
    rotation = wrap_angle(target.yaw - tool.yaw, math.pi)
    distance = planar_distance(target.position, tool.position)
    if distance < ALIGNED and abs(rotation) < ALIGNED_YAW and abs(target.z - tool.z) < DEEP:
        return Waypoint(Pose.planar(*target.position, tool.yaw + rotation), OPEN, finish=CLOSED)
    # The distance that remains after this step limits the descent: a continuous plan corrects the errors of
    # an agent that imitates it.
    dx = max(0.0, abs(target.x - tool.x) - scene.max_translation)
    dy = max(0.0, abs(target.y - tool.y) - scene.max_translation)
    left = max(math.hypot(dx, dy), FUNNEL_ROTATION * max(0.0, abs(rotation) - scene.max_rotation))
    apart = max(left, max(distance, FUNNEL_ROTATION * abs(rotation)) / 2.0 - ALIGNED)
    top = max(target.z, clutter.top_between(tool.position, target.position, reach) + HOVER)
    height = target.z + (top - target.z) * min(1.0, max(0.0, apart / FUNNEL))
    return Waypoint(Pose.planar(target.x, target.y, height, tool.yaw + rotation), OPEN)


def _half_turns(angles: FloatArray) -> FloatArray:
    """Return equivalent yaws (rad) of a symmetric gripper in [-pi/2, pi/2)."""
    return (angles + math.pi / 2.0) % math.pi - math.pi / 2.0
