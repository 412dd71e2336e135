"""Picking blocks up and putting them down in one action each: tools that open-loop experts share.

A block is seen through its *lying frame*: z up from the side it lies on, y along the longer of its level
sides, its origin where it is best taken, along x. It can be put down in any of the ways that look the same.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP
from bulletarm_gym.control.open_loop import HALF_TURN, MAX_TILT, MOTION
from bulletarm_gym.experts.approach import RELEASE
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
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
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.simulation import Box

SQUARENESS = 1.05
"""A block whose level sides differ by less than this factor can be turned by a quarter."""
FINGER_CLEARANCE = 0.002
"""Gap (m) between the open fingers and what is beside them."""
GRIP_PLACES = 25
"""Places along a block at which it may be taken."""
FLUSH = 1e-3
"""Faces this near (m) to the foremost one are touched, too."""
OFF_CENTRE = 0.5
"""A grip that far (m) from the middle is as bad as one a metre askew."""
TIP_CLEARANCE = 0.0015
"""Gap (m) between the fingertips and the ground under them."""
SWEEP = np.concatenate([sign * np.linspace(0.3, 1.0, 12) for sign in (-1.0, 1.0)])
"""Where the ground under the closing fingers is looked at, in their farthest reach."""
OPENING_PLAY = 0.008
"""What the gripper opens wider (m) than a block, at least, to take it."""
LIFTS = (0.0, 0.15, 0.3)
"""How far above its middle, in heights, a block may be taken."""
OVERHANG = 0.005
"""What reaches less (m) beyond the open fingers than this needs no room of its own."""
PALM_CLEARANCE = 0.004
"""Gap (m) between a palm and what is beside or under it."""
LEANS = (0.0, -0.15, 0.15, -0.3, 0.3, -0.45, 0.45)
"""Tilts (rad) of a hand whose palm has no room when it comes in straight."""
ASIDES = (0.0, -0.25, 0.25)
"""How far from its middle, in lengths, an item is taken then."""
LEANING_LIFTS = (-0.2, 0.0, 0.15)
"""How far above its middle, in heights: low, where a roof is wide."""
SKEWS = (0.0, 0.5, -0.5)
"""How far (rad) the fingers may be turned against the item's sides: it turns between them as they close."""
TRIES = 4
"""Of so many such grasps one is drawn: what has slipped once is not taken in the same way again."""
HERE = Pose((0.0, 0.0, 0.0))
NEAREST_STOP = Pose((0.0, 0.0, MOTION.stops[-1][0]))
"""Nearest pose from which open-loop control begins a pick or place, in the frame of its target."""


def resting_frame(item: SceneObject) -> Pose:
    """Return an item's lying frame, in the world.

    Boxes may lie on any side; all else keeps its own axes, turned over if it lies upside down.
    """
    return item.cached_by_pose(_lying_frame)


def _lying_frame(item: SceneObject) -> Pose:
    rotation = matrix(item.pose)
    if not is_box(item):
        flip = np.diag([1.0, -1.0, -1.0]) if rotation[2, 2] < 0.0 else np.eye(3)
        return Pose(item.pose.transform(item.cached_by_shape(_grip_point)), quaternion(rotation @ flip))
    up = int(abs(rotation[2]).argmax())
    _, long = sorted({0, 1, 2} - {up}, key=lambda axis: (item.spec.extents[axis], axis))
    z, y = math.copysign(1.0, rotation[2, up]) * rotation[:, up], rotation[:, long]
    (y0, y1, y2), (z0, z1, z2) = y, z
    x = (y1 * z2 - y2 * z1, y2 * z0 - y0 * z2, y0 * z1 - y1 * z0)
    return Pose(item.pose.position, quaternion(np.array([x, y, z]).T))


def _grip_point(item: SceneObject) -> Vector:
    """Return where (m) in its frame fingers that close along x hold an item: square on, near its middle."""
    low, high = (item.spec.piece_bounds[:, end, :2] for end in (0, 1))
    end = np.abs(item.spec.mesh.bounds[:, 1]).max()
    points = [_held_at(low, high, y, item.pad_width) for y in np.linspace(-end, end, GRIP_PLACES).tolist()]
    grip = min(points)
    return (grip.x, grip.y, 0.0)


class Grip(NamedTuple):
    """Where fingers that close along x may hold an item, in its frame; of two the lesser is the better.

    :param badness: how far (m) the fingers are from square on, wide and near the middle
    :param x: of the middle between the fingers (m)
    :param y: of the fingers (m)
    """

    badness: float
    x: float
    y: float


def _held_at(low: FloatArray, high: FloatArray, y: float, pad: float) -> Grip:
    """Return how fingers hold an item at y.

    :param low: lowest x and y of each piece, (n, 2) m
    :param high: highest x and y of each piece
    :param pad: width (m) of the fingers' pads
    """
    start, stop = np.maximum(low[:, 1], y - pad / 2.0), np.minimum(high[:, 1], y + pad / 2.0)
    between = stop > start
    if not between.any():
        return Grip(math.inf, 0.0, y)
    left, right = float(low[between, 0].min()), float(high[between, 0].max())
    touched = [between & (low[:, 0] < left + FLUSH), between & (high[:, 0] > right - FLUSH)]
    lengths = [float((stop - start)[pieces].sum()) for pieces in touched]
    middles = [float(((start + stop) / 2.0)[pieces].mean()) for pieces in touched]
    badness = abs(middles[0] - middles[1]) + OFF_CENTRE * abs(y) - min(lengths)
    return Grip(badness, (left + right) / 2.0, y)


def is_box(item: SceneObject) -> bool:
    """Whether an item is a cuboid."""
    pieces = item.spec.pieces
    return len(pieces) == 1 and isinstance(pieces[0].shape, Box)


class Corners(NamedTuple):
    """The box along a frame's axes that an item fills.

    :param low: lowest x, y and z (m)
    :param high: highest
    """

    low: Vector
    high: Vector

    @property
    def sides(self) -> Vector:
        """Full side lengths (m)."""
        (x0, y0, z0), (x1, y1, z1) = self
        return (x1 - x0, y1 - y0, z1 - z0)

    @property
    def middle(self) -> Vector:
        """Its middle (m), on the plane z = 0."""
        return ((self.low[0] + self.high[0]) / 2.0, (self.low[1] + self.high[1]) / 2.0, 0.0)


def lying_corners(item: SceneObject) -> Corners:
    """Return the corners of an item in its lying frame."""
    return item.cached_by_pose(_lying_corners)


def _lying_corners(item: SceneObject) -> Corners:
    inside = resting_frame(item).inverse().compose(item.pose)
    points = item.spec.mesh.vertices @ matrix(inside).T + inside.position
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return Corners((x0, y0, z0), (x1, y1, z1))


def pick(scene: Scene, item: SceneObject, rng: np.random.Generator) -> Waypoint:
    """Return the pick of an item: about its middle, or higher if the fingers have room only there.

    The fingers close across the shorter of its sides, or along if there they have room.

    :param rng: draws one of the ways if none has room: one of them may do all the same
    """
    frame = resting_frame(item)
    _, length, height = lying_corners(item).sides
    stroke = scene.robot.model.gripper.stroke
    turns = [0.0, math.pi / 2.0] if is_box(item) and length + OPENING_PLAY <= stroke else [0.0]
    lifts = [share * height for share in LIFTS]
    hands = [_able(scene, frame.compose(Pose.planar(0.0, 0.0, z, turn))) for z in lifts for turn in turns]
    drawn = hands[int(rng.integers(len(hands)))]
    best = next((hand for hand in hands if _fits(scene, hand, item)), None)
    is_wide = scene.robot.model.gripper.overhang > OVERHANG
    if best is None and (is_wide or not any(_reaches(scene, hand) for hand in hands)):
        leaning = (hand for hand in _leaning(scene, item, turns) if _fits(scene, hand, item))
        some = list(itertools.islice(leaning, TRIES))
        best = some[int(rng.integers(len(some)))] if some else None
    if best is None:  # no grasp has room for the wrist, one may for the fingers
        best = next((hand for hand in hands if all(_rank(scene, hand, item))), drawn)
    return Waypoint(best, OPEN, finish=CLOSED)


def _leaning(scene: Scene, item: SceneObject, turns: Sequence[float]) -> list[Pose]:
    """Return grasps by which a wide palm may get past what is beside an item, the least tilted ones first.

    The hand leans along the fingers' sides or to where they open; it takes a long item nearer to an end.
    """
    leans = LEANS if scene.config.action_sequence.count("r") == 3 else LEANS[:1]
    width, length, height = lying_corners(item).sides
    asides = [share * length for share in ASIDES] if is_box(item) or length > 2.0 * width else [0.0]
    skews = SKEWS if scene.config.control == CLOSE_LOOP else SKEWS[:1]
    tilts = sorted(itertools.product(leans, leans), key=lambda tilt: math.hypot(*tilt))
    frame = resting_frame(item)
    return [
        _able(scene, frame.compose(euler_pose((0.0, aside, lift * height), (along, across, turn + skew))))
        for skew in skews
        for along, across in tilts
        for aside in asides
        for lift in LEANING_LIFTS
        for turn in turns
    ]


def put(scene: Scene, item: SceneObject, grounds: Sequence[Pose]) -> Waypoint:
    """Return the place of the held item.

    :param grounds: frames it may as well be put on: the middle of the block just above the origin of one
    """
    hand, lying = scene.robot.pose, resting_frame(item)
    in_hand = lying.inverse().compose(hand)
    middle = lying_corners(item).middle
    held_at = in_hand.inverse().transform(middle)
    goals = (ground.compose(turned) for ground in grounds for turned in _lying(item))
    hands = (_bring(scene, goal.compose(in_hand), held_at, goal.transform(middle)) for goal in goals)
    # In open loop half a turn is none, see half_rotation; in close loop it has to be made.
    turn = math.pi if scene.config.control == OPEN_LOOP else 2.0 * math.pi
    best = max(
        hands, key=lambda goal: (*_rank(scene, goal, item), -abs(wrap_angle(goal.yaw - hand.yaw, turn)))
    )
    return Waypoint(best, CLOSED, finish=OPEN)


def _lying(item: SceneObject) -> Iterator[Pose]:
    """Yield the lying frame over the ground, in every way that looks the same."""
    corners = lying_corners(item)
    level = corners.sides[:2]
    turns = 4 if max(level) < SQUARENESS * min(level) else 2
    x, y, _ = corners.middle
    for turn in range(turns):
        turned = Pose.planar(0.0, 0.0, RELEASE - corners.low[2], 2.0 * math.pi * turn / turns)
        yield turned.compose(Pose((-x, -y, 0.0)))


def _able(scene: Scene, hand: Pose) -> Pose:
    """Return the nearest pose that an action can tell."""
    turns = scene.config.action_sequence.count("r")
    if turns == 3 and hand.tilt < MAX_TILT:
        return hand
    return Pose.planar(*hand.position, hand.yaw if turns else scene.robot.pose.yaw)


def _bring(scene: Scene, hand: Pose, held_at: Vector, goal: Vector) -> Pose:
    """Return the pose nearest to a hand's that an action can tell and that brings what is held to a point.

    :param held_at: the middle of what is held in the hand's frame (m)
    :param goal: where that is to come (m)
    """
    able = _able(scene, hand)
    if able is hand:
        return hand
    x, y, z = rotate(able.orientation, held_at)
    return Pose((goal[0] - x, goal[1] - y, goal[2] - z), able.orientation)


def _rank(scene: Scene, hand: Pose, item: SceneObject) -> tuple[bool, bool, bool]:
    return _reaches(scene, hand), fingers_fit(scene, hand, item), palm_fits(scene, hand, item)


def _reaches(scene: Scene, hand: Pose) -> bool:
    """Return True if a pick or place is in reach, with the nearest pose from which it can begin."""
    hand = _symmetric(hand)
    return scene.robot.reaches(hand) and scene.robot.reaches(hand.compose(NEAREST_STOP))


def _symmetric(hand: Pose) -> Pose:
    """Return the symmetric tool pose within a quarter turn of the home pose."""
    return hand if -math.pi / 2.0 <= hand.yaw < math.pi / 2.0 else hand.compose(HALF_TURN)


def _fits(scene: Scene, hand: Pose, item: SceneObject) -> bool:
    """Whether a grasp is in reach and has room, what is soonest known first."""
    return (
        palm_fits(scene, hand, item)
        and fingers_fit(scene, hand, item)
        and _reaches(scene, hand)
        and _wrist_fits(scene, hand, item)
    )


def palm_fits(scene: Scene, hand: Pose, item: SceneObject) -> bool:
    """Whether a palm that reaches out beyond the fingers touches nothing but an item on its way in to a pose.

    Other palms touch nothing that the fingers would not touch.
    """
    gripper = scene.robot.model.gripper
    if gripper.overhang <= OVERHANG:
        return True
    length, width, _ = gripper.palm
    root = gripper.finger[2]
    under = _lattice(length, width, root) @ matrix(hand).T + hand.position
    if (scene.surface.heights(under[:, :2]) + PALM_CLEARANCE > under[:, 2]).any():
        return False
    outline, lowest = Footprint.rectangle((length, width), HERE), float(under[:, 2].min())
    others = (other for other in scene if other is not item and other is not scene.held)
    high = (other for other in others if scene.world.top(other.body) > lowest)
    return all(outline.gap(_beyond(other, hand, root)) > PALM_CLEARANCE for other in high)


def _wrist_fits(scene: Scene, hand: Pose, item: SceneObject) -> bool:
    """Whether the arm, its palm and wrist too, touches nothing that stands higher than the fingers reach."""
    root = hand.z + scene.robot.model.gripper.finger[2]
    others = (other.body for other in scene if other is not item and other is not scene.held)
    high = [body for body in others if scene.world.top(body) > root]
    return not high or scene.robot.is_free_at(_symmetric(hand), high)


def _beyond(item: SceneObject, hand: Pose, height: float) -> Footprint:
    """Return what an item covers at a height (m) of a hand's frame and above, seen along its z axis."""
    world = item.spec.mesh.vertices @ matrix(item.pose).T + item.pose.position
    points = (world - hand.position) @ matrix(hand)
    above, below = points[points[:, 2] > height], points[points[:, 2] <= height]
    start, end = (np.repeat(below, len(above), axis=0), np.tile(above, (len(below), 1)))
    share = (height - start[:, 2:]) / (end[:, 2:] - start[:, 2:])
    return Footprint(np.concatenate([above, start + share * (end - start)])[:, :2])


@lru_cache(maxsize=4)
def _lattice(length: float, width: float, height: float) -> FloatArray:
    """Return where the ground under a palm is looked at, (n, 3) m in the hand's frame."""
    along, across = np.meshgrid(length * np.linspace(-0.5, 0.5, 11), width * np.linspace(-0.5, 0.5, 5))
    return np.stack([along.ravel(), across.ravel(), np.full(along.size, height)], axis=1)


def fingers_fit(scene: Scene, hand: Pose, item: SceneObject) -> bool:
    """Whether the open fingers can close, their tips at a pose, and touch nothing but an item."""
    gripper = scene.robot.model.gripper
    thickness, width, _ = gripper.finger
    far = gripper.stroke / 2.0 + thickness
    tips = _swept(far, width) @ matrix(hand).T + hand.position
    if (scene.surface.heights(tips[:, :2]) + TIP_CLEARANCE > tips[:, 2]).any():
        return False
    fingers = [hand.compose(Pose((side * (far - thickness / 2.0), 0.0, 0.0))) for side in (1.0, -1.0)]
    bases = [(Footprint.rectangle((thickness, width), finger), finger.z) for finger in fingers]
    lowest, held = float(tips[:, 2].min()), scene.held
    for other in scene:
        if other is item or other is held or (top := scene.world.top(other.body)) <= lowest:
            continue
        shadow = footprint(other)
        if any(base.gap(shadow) < FINGER_CLEARANCE and top > z for base, z in bases):
            return False
    return True


@lru_cache(maxsize=16)
def _swept(far: float, width: float) -> FloatArray:
    """Return where the ground under the closing fingers is looked at, (n, 3) m in the hand's frame.

    :param far: the open fingers' outer sides (m)
    :param width: of a finger (m)
    """
    along, across = np.meshgrid(far * SWEEP, width * np.linspace(-0.5, 0.5, 5))
    return np.stack([along.ravel(), across.ravel(), np.zeros(along.size)], axis=1)
