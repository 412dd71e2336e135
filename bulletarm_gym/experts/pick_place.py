"""Picks and places of blocks, shared by the experts that plan whole picks and places.

Each block has a *resting frame*: z points up from the side on which the block rests, y is along the longer of
its horizontal sides, and the origin is where the block is best grasped with fingers that open along x.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.control.open_loop import HALF_TURN, MAX_TILT, MOTION
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import RELEASE
from bulletarm_gym.geometry import (
    FloatArray,
    Footprint,
    Pose,
    Vector,
    euler_pose,
    matrix,
    quaternion,
    rotate,
    wrap_angle,
)
from bulletarm_gym.scene import Scene, SceneObject, cached_by_pose
from bulletarm_gym.scene.predicates import is_top, loose_objects
from bulletarm_gym.scene.sampling import footprint, free_pose, sample_until
from bulletarm_gym.simulation import Box

SQUARENESS = 1.05
"""Largest ratio of a block's horizontal sides at which a rotation by pi/2 is a symmetry."""
FINGER_CLEARANCE = 0.002
"""Gap (m) between the open fingers and other objects."""
TIP_CLEARANCE = 0.0015
"""Gap (m) between the fingertips and the surface below them."""
OPENING_PLAY = 0.008
"""Smallest difference (m) between the opening and the side of a block that is grasped along its length."""
OVERHANG = 0.005
"""Distance (m) by which a palm may be wider than the open fingers without a collision check."""
PALM_CLEARANCE = 0.004
"""Gap (m) between a palm and other objects or the surface."""
CANDIDATES = 4
"""Number of candidate grasps to sample from, so that a retry after a slip uses a different grasp."""
ACROSS = np.linspace(-0.5, 0.5, 5)
"""Positions of evaluated surface points across the opening, relative to the width of the palm or finger."""
PALM_POINTS = np.array([(x, y, 0.0) for y in ACROSS for x in np.linspace(-0.5, 0.5, 11)])
"""Points below a palm at which the surface is evaluated, (n, 3), relative to its length and width."""
FINGER_POINTS = np.array(
    [(side * x, y, 0.0) for y in ACROSS for side in (-1.0, 1.0) for x in np.linspace(0.3, 1.0, 12)]
)
"""Points below the closing fingers, (n, 3), relative to the open fingers' outer side and width."""


class RestingBox(NamedTuple):
    """Bounding box of an object in its resting frame.

    :param sides: side lengths (m)
    :param middle: centre (m), projected to z = 0
    :param bottom: z of the lower side (m)
    """

    sides: Vector
    middle: Vector
    bottom: float


def is_box(obj: SceneObject) -> bool:
    """Return True if an object is a cuboid."""
    pieces = obj.spec.pieces
    return len(pieces) == 1 and isinstance(pieces[0].shape, Box)


@cached_by_pose
def resting_frame(obj: SceneObject) -> Pose:
    """Return an object's resting frame in the world.

    A box rests on any side. Other objects keep their axes, rotated by pi about x if they are upside down.
    """
    rotation = matrix(obj.pose)
    if not is_box(obj):
        flip = np.diag([1.0, -1.0, -1.0]) if rotation[2, 2] < 0.0 else np.eye(3)
        return Pose(obj.pose.transform(obj.cached(_grip_point, obj.variant)), quaternion(rotation @ flip))
    up = int(abs(rotation[2]).argmax())
    _, long = sorted({0, 1, 2} - {up}, key=lambda axis: (obj.spec.extents[axis], axis))
    z, y = math.copysign(1.0, rotation[2, up]) * rotation[:, up], rotation[:, long]
    return Pose(obj.pose.position, quaternion(np.array([np.cross(y, z), y, z]).T))


def _grip_point(obj: SceneObject) -> Vector:
    """Return the best point (m), in an object's frame, for fingers that close along x."""
    low, high = (obj.spec.piece_bounds[:, end, :2] for end in (0, 1))
    end = np.abs(obj.spec.mesh.bounds[:, 1]).max()
    _, x, y = min(_grip_cost(low, high, y, obj.pad_width) for y in np.linspace(-end, end, 25).tolist())
    return (x, y, 0.0)


def _grip_cost(low: FloatArray, high: FloatArray, y: float, pad: float) -> tuple[float, float, float]:
    """Return the cost (m) of a grasp at y, and x and y (m) of the middle between the fingers.

    :param low: smallest x and y of each piece, (n, 2) m; ``high``: the largest ones
    """
    start, stop = np.maximum(low[:, 1], y - pad / 2.0), np.minimum(high[:, 1], y + pad / 2.0)
    between = stop > start
    if not between.any():
        return math.inf, 0.0, y
    left, right = float(low[between, 0].min()), float(high[between, 0].max())
    touched = [between & (low[:, 0] < left + 1e-3), between & (high[:, 0] > right - 1e-3)]
    lengths = [float((stop - start)[pieces].sum()) for pieces in touched]
    middles = [float(((start + stop) / 2.0)[pieces].mean()) for pieces in touched]
    # Misalignment of the touched sides, plus half the distance from the object's centre.
    cost = abs(middles[0] - middles[1]) + 0.5 * abs(y) - min(lengths)
    return cost, (left + right) / 2.0, y


@cached_by_pose
def resting_box(obj: SceneObject) -> RestingBox:
    """Return the bounding box of an object in its resting frame."""
    inside = resting_frame(obj).inverse().compose(obj.pose)
    points = obj.spec.mesh.vertices @ matrix(inside).T + inside.position
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return RestingBox((x1 - x0, y1 - y0, z1 - z0), ((x0 + x1) / 2.0, (y0 + y1) / 2.0, 0.0), z0)


def pick(scene: Scene, obj: SceneObject, rng: np.random.Generator, opening: float = math.inf) -> Waypoint:
    """Return the pick of an object: at its centre, or up to 0.3 of its height above it without a collision.

    The fingers close across the shorter side, or along it if they collide otherwise.

    :param rng: samples a grasp if all of them collide; the sampled grasp may succeed nevertheless
    :param opening: distance (m) between the open fingers, limited by the stroke
    """
    frame = resting_frame(obj)
    _, length, height = resting_box(obj).sides
    gripper = scene.robot.model.gripper
    fits_along = length + OPENING_PLAY <= min(opening, gripper.stroke)
    yaws = [0.0, math.pi / 2.0] if is_box(obj) and fits_along else [0.0]
    lifts = [share * height for share in (0.0, 0.15, 0.3)]
    poses = [_feasible(scene, frame.compose(Pose.planar(0.0, 0.0, z, yaw))) for z in lifts for yaw in yaws]
    sampled = poses[int(rng.integers(len(poses)))]
    best = next((pose for pose in poses if _fits(scene, pose, obj)), None)
    if best is None and (gripper.overhang > OVERHANG or not any(_reaches(scene, pose) for pose in poses)):
        leaning = (pose for pose in _leaning(scene, obj, yaws) if _fits(scene, pose, obj))
        candidates = list(itertools.islice(leaning, CANDIDATES))
        best = candidates[int(rng.integers(len(candidates)))] if candidates else None
    if best is None:  # the wrist collides in every grasp, the fingers may not
        best = next((pose for pose in poses if all(_rank(scene, pose, obj))), sampled)
    return Waypoint(best, OPEN, finish=CLOSED)


def _leaning(scene: Scene, obj: SceneObject, yaws: Sequence[float]) -> list[Pose]:
    """Return grasps that avoid collisions of a wide palm by tilts and offsets, the least tilted first."""
    width, length, height = resting_box(obj).sides
    tilts = (0.0, -0.15, 0.15, -0.3, 0.3, -0.45, 0.45)
    leans = tilts if scene.config.action_sequence.count("r") == 3 else (0.0,)
    pairs = sorted(itertools.product(leans, leans), key=lambda pair: math.hypot(*pair))
    # The block rotates as the fingers close.
    skews = (0.0, 0.5, -0.5) if scene.config.control == CLOSE_LOOP else (0.0,)
    offsets = (0.0, -0.25, 0.25) if is_box(obj) or length > 2.0 * width else (0.0,)
    frame = resting_frame(obj)
    return [
        _feasible(scene, frame.compose(euler_pose((0.0, y * length, z * height), (*pair, yaw + skew))))
        for skew, pair, y, z, yaw in itertools.product(skews, pairs, offsets, (-0.2, 0.0, 0.15), yaws)
    ]


def put(scene: Scene, obj: SceneObject, frame: Pose) -> Waypoint:
    """Return the place of the grasped object.

    :param frame: frame of the support; the object's centre is released above its origin
    """
    tool, box = scene.robot.pose, resting_box(obj)
    in_frame = resting_frame(obj).inverse().compose(tool)
    middle = in_frame.inverse().transform(box.middle)
    poses = []
    for goal in map(frame.compose, _symmetric_frames(box)):
        pose = goal.compose(in_frame)
        feasible = _feasible(scene, pose)
        if feasible is not pose:  # the object's centre must have the same position
            ends = zip(goal.transform(box.middle), rotate(feasible.orientation, middle), strict=True)
            x, y, z = (end - offset for end, offset in ends)
            feasible = Pose((x, y, z), feasible.orientation)
        poses.append(feasible)
    # Open-loop control rotates by up to pi/2 only, see half_rotation; closed-loop control by up to pi.
    period = math.pi if scene.config.control == OPEN_LOOP else 2.0 * math.pi
    best = max(
        poses, key=lambda pose: (*_rank(scene, pose, obj), -abs(wrap_angle(pose.yaw - tool.yaw, period)))
    )
    return Waypoint(best, CLOSED, finish=OPEN)


def _symmetric_frames(box: RestingBox) -> Iterator[Pose]:
    """Yield the resting frames of symmetric poses of an object, relative to the frame of its support."""
    level = box.sides[:2]
    count = 4 if max(level) < SQUARENESS * min(level) else 2
    x, y, _ = box.middle
    for number in range(count):
        rotated = Pose.planar(0.0, 0.0, RELEASE - box.bottom, 2.0 * math.pi * number / count)
        yield rotated.compose(Pose((-x, -y, 0.0)))


def _feasible(scene: Scene, pose: Pose) -> Pose:
    """Return the nearest tool pose in the action space."""
    rotations = scene.config.action_sequence.count("r")
    if rotations == 3 and pose.tilt < MAX_TILT:
        return pose
    return Pose.planar(*pose.position, pose.yaw if rotations else scene.robot.pose.yaw)


def _rank(scene: Scene, pose: Pose, obj: SceneObject) -> tuple[bool, bool, bool]:
    return _reaches(scene, pose), fingers_fit(scene, pose, obj), palm_fits(scene, pose, obj)


def _fits(scene: Scene, pose: Pose, obj: SceneObject) -> bool:
    """Return True if a grasp is in reach and without collisions; the fastest check comes first."""
    return (
        palm_fits(scene, pose, obj)
        and fingers_fit(scene, pose, obj)
        and _reaches(scene, pose)
        and _wrist_fits(scene, pose, obj)
    )


def _reaches(scene: Scene, pose: Pose) -> bool:
    """Return True if a pick or place is in reach, with the nearest pose from which it can begin."""
    pose, nearest = _nearest_symmetric(pose), Pose((0.0, 0.0, MOTION.stops[-1][0]))
    return scene.robot.reaches(pose) and scene.robot.reaches(pose.compose(nearest))


def _nearest_symmetric(pose: Pose) -> Pose:
    """Return the symmetric tool pose within pi/2 of the home pose."""
    return pose if -math.pi / 2.0 <= pose.yaw < math.pi / 2.0 else pose.compose(HALF_TURN)


def _others(scene: Scene, obj: SceneObject, height: float) -> list[SceneObject]:
    """Return the objects that reach above a height (m), without one and without the grasped object."""
    ignored = (obj, scene.held)
    others = (other for other in scene if other not in ignored)
    return [other for other in others if scene.world.top(other.body) > height]


def palm_fits(scene: Scene, pose: Pose, obj: SceneObject) -> bool:
    """Return True if the palm touches nothing except an object on a straight approach to a pose.

    A palm that is not wider than the open fingers always fits.
    """
    gripper = scene.robot.model.gripper
    if gripper.overhang <= OVERHANG:
        return True
    length, width, _ = gripper.palm
    root = gripper.finger[2]
    under = (PALM_POINTS * (length, width, 0.0) + (0.0, 0.0, root)) @ matrix(pose).T + pose.position
    if (scene.surface.heights(under[:, :2]) + PALM_CLEARANCE > under[:, 2]).any():
        return False
    outline = Footprint.rectangle((length, width), Pose((0.0, 0.0, 0.0)))
    others = _others(scene, obj, float(under[:, 2].min()))
    return outline.gap(*(_footprint_above(other, pose, root) for other in others)) > PALM_CLEARANCE


def _wrist_fits(scene: Scene, pose: Pose, obj: SceneObject) -> bool:
    """Return True if the arm, with palm and wrist, touches no object that is higher than the finger roots."""
    high = [other.body for other in _others(scene, obj, pose.z + scene.robot.model.gripper.finger[2])]
    return not high or scene.robot.is_free_at(_nearest_symmetric(pose), high)


def _footprint_above(obj: SceneObject, pose: Pose, height: float) -> Footprint:
    """Return the footprint, along a tool's z axis, of the part of an object above a height (m) there."""
    world = obj.spec.mesh.vertices @ matrix(obj.pose).T + obj.pose.position
    points = (world - pose.position) @ matrix(pose)
    above, below = points[points[:, 2] > height], points[points[:, 2] <= height]
    start, end = (np.repeat(below, len(above), axis=0), np.tile(above, (len(below), 1)))
    share = (height - start[:, 2:]) / (end[:, 2:] - start[:, 2:])
    return Footprint(np.concatenate([above, start + share * (end - start)])[:, :2])


def fingers_fit(scene: Scene, pose: Pose, obj: SceneObject) -> bool:
    """Return True if the fingers can close, from open, at a pose and touch nothing except an object."""
    gripper = scene.robot.model.gripper
    thickness, width, _ = gripper.finger
    far = gripper.half_width()
    tips = FINGER_POINTS * (far, width, 0.0) @ matrix(pose).T + pose.position
    if (scene.surface.heights(tips[:, :2]) + TIP_CLEARANCE > tips[:, 2]).any():
        return False
    fingers = [pose.compose(Pose((side * (far - thickness / 2.0), 0.0, 0.0))) for side in (1.0, -1.0)]
    bases = [(Footprint.rectangle((thickness, width), finger), finger.z) for finger in fingers]
    return not any(
        base.gap(footprint(other)) < FINGER_CLEARANCE and scene.world.top(other.body) > z
        for other in _others(scene, obj, float(tips[:, 2].min()))
        for base, z in bases
    )


GRASP_CLEARANCE = 0.04
"""Smallest gap (m) between blocks on the surface, for an open finger."""
SAME_LEVEL = 0.5
"""Largest height difference of blocks at the same level, relative to their height."""


def deconstruct(scene: Scene, rng: np.random.Generator) -> list[Waypoint]:
    """Move all blocks of a structure but the last to the surface, from the top, without the arm.

    :param scene: scene whose loose objects are the structure
    :param rng: samples the order of blocks at the same level and their new poses
    :return: alternating picks and places that build the structure again; they may fail
    :raises PlacementError: the surface has no space for a block
    """
    remaining = loose_objects(scene)
    plan: list[Waypoint] = []
    while len(remaining) > 1:
        free = [block for block in remaining if is_top(block, remaining)]
        highest = max(block.pose.z for block in free)
        level = [block for block in free if highest - block.pose.z < SAME_LEVEL * block.spec.extents[2]]
        block = level[int(rng.integers(len(level)))]
        remaining.remove(block)
        plan = [*_relocate(scene, rng, block), *plan]
    return plan


def _relocate(scene: Scene, rng: np.random.Generator, block: SceneObject) -> tuple[Waypoint, Waypoint]:
    """Place a block on the surface; return the pick and the place that move it back with the same grasp."""
    before = block.pose
    in_block = pick(scene, block, rng).pose.inverse().compose(before).inverse()

    def is_graspable(pose: Pose) -> bool:
        tool = pose.compose(in_block)
        start = tool.compose(Pose((0.0, 0.0, MOTION.approach)))
        return fingers_fit(scene, tool, block) and scene.robot.reaches(tool) and scene.robot.reaches(start)

    after = sample_until(lambda: free_pose(scene, rng, block, GRASP_CLEARANCE), is_graspable)
    block.place(after)
    above = before.compose(Pose((0.0, 0.0, RELEASE)))
    return (
        Waypoint(after.compose(in_block), OPEN, finish=CLOSED),
        Waypoint(above.compose(in_block), CLOSED, finish=OPEN),
    )
