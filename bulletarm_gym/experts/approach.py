"""Waypoints for grasping an item from above and putting it down: tools that tasks' experts share."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bulletarm_gym.control.open_loop import HALF_TURN, MOTION
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose, matrix, planar_distance, rotate, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject

ALIGNED = 0.012
"""Distance (m) in the plane at which the fingers go down beside an item without touching it ..."""
ALIGNED_YAW = 0.25
"""... and the angle (rad)."""
HEIGHT_TOLERANCE = 5e-3
"""Height (m) that the fingertips may lack."""
HOVER = 0.03
"""Height (m) of the fingertips over an item while they line up with it."""
PRECISE = 0.003
"""Distance (m) from which close-loop control goes down to a pick or place: it may be narrow there."""
NEARLY_DOWN = 0.01
"""Height (m) over a pick or place from which the fingers do not go back up to line up anew."""
READY = 0.9
"""Opening ratio from which the gripper is ready to grasp."""
PASSING = 0.03
"""Gap (m) between what is carried and what it is carried over: wide, as agents are not so exact."""
SLANTED = math.radians(8.0)
"""Slope (rad) from which fingers that come straight down slip off a side."""
RELEASE = 0.003
"""Gap (m) under an item that is let go."""
AT_LIMIT = 0.03
"""Distance (rad) of the last joint from its limit within which the other joints make up for its rotation.

Inverse kinematics then ends up to 0.02 rad before the limit, and only at some heights in one straight motion.
"""
WRIST_MARGIN = 1.0
"""Rotation (rad) of the last joint beyond that of the gripper, as the arm moves across the workspace."""
PASSING_ASIDE = 0.005
"""Gap (m) beside the open gripper within which an object is in its way."""


def route(scene: Scene, move: Waypoint, opening: float) -> Iterator[Waypoint]:
    """Yield the way of close-loop control to a pick or place: up, over what is in between, straight down.

    :param move: with a finish: a pick if that closes the gripper, else a place
    :param opening: greatest opening ratio that leaves what is beside the fingers alone; a pick may set a
        smaller one
    """
    assert move.finish is not None
    hand, held, goal = scene.robot.pose, scene.held, move.pose
    if "r" not in scene.config.action_sequence:
        goal = Pose.planar(*goal.position, hand.yaw)
    if held is None or move.finish < move.gripper:
        top = max(goal.z, highest_between(scene, hand.position, goal.position, held))
        yield from grasp(scene, goal, top, math.pi, min(opening, move.gripper), PRECISE)
    else:
        height = goal.z - hand.z + held.lowest
        apart = scene.robot.opening_ratio + MOTION.release / scene.robot.model.gripper.stroke
        yield from _carry(scene, held, goal, height, min(apart, opening), PRECISE)


def exchange_fingers(scene: Scene, pose: Pose) -> Pose:
    """Return a tool pose turned by half about the gripper's axis, with the grasped object's middle in place.

    A parallel gripper is symmetric, and so is every object that experts place.
    """
    if scene.held is None:
        return pose.compose(HALF_TURN)
    x, y, _ = scene.robot.pose.inverse().transform(scene.held.pose.position)
    return pose.compose(Pose((x, y, 0.0))).compose(HALF_TURN).compose(Pose((-x, -y, 0.0)))


def avoid_limits(scene: Scene, pose: Pose) -> Pose:
    """Return a tool pose, or the symmetric one if only that can be reached without meeting a joint limit."""
    robot = scene.robot
    if robot.wrist_room() > abs(wrap_angle(pose.yaw - robot.pose.yaw)) + WRIST_MARGIN:
        return pose
    possible = [other for other in (pose, exchange_fingers(scene, pose)) if robot.can_move_to(other)]
    return next((other for other in possible if robot.wrist_room(other) > AT_LIMIT), (*possible, pose)[0])


def grasp(
    scene: Scene, target: Pose, top: float, symmetry: float, opening: float = OPEN, near: float = ALIGNED
) -> Iterator[Waypoint]:
    """Yield the way to a grasp from wherever the empty gripper is.

    Straight in where the fingers are above the item for as long as they are not aligned with it, else up,
    across and down.

    :param target: of the fingertips when they close
    :param top: height (m) of the highest point of the item, or of what is on the way to it
    :param symmetry: turning the gripper by this angle (rad) gives as good a grasp
    :param opening: ratio to come in with
    :param near: distance (m) in the plane at which the fingers may go down
    """
    hand = scene.robot.pose
    turn = wrap_angle(target.yaw - hand.yaw, symmetry)
    goal = avoid_limits(scene, Pose.planar(*target.position, hand.yaw + turn))
    turn = wrap_angle(goal.yaw - hand.yaw)
    apart = max(abs(goal.x - hand.x), abs(goal.y - hand.y))
    aligned = _is_aligned(goal, hand, turn, near)
    ready = scene.robot.opening_ratio > READY * opening
    hover = top + HOVER
    if hand.z < hover - HEIGHT_TOLERANCE and not (
        (aligned and ready) or _stays_above(scene, apart, turn, top)
    ):
        width = opening if hand.z > top else scene.robot.opening_ratio
        yield Waypoint(Pose.planar(hand.x, hand.y, hover, hand.yaw), width)
    closes_at_once = not ready and hand.z - goal.z < scene.max_translation
    if closes_at_once or not (aligned or _stays_above(scene, apart, turn, top)):
        yield Waypoint(Pose.planar(goal.x, goal.y, hover, goal.yaw), opening)
    yield Waypoint(goal, opening, finish=CLOSED, clear=True)


def _is_aligned(goal: Pose, hand: Pose, turn: float, near: float) -> bool:
    """Whether the fingers may go straight to a goal, from within a distance (m) in the plane.

    Close to it they may also where contacts have pushed them aside.
    """
    apart = planar_distance(goal.position, hand.position)
    near = ALIGNED if hand.z < goal.z + NEARLY_DOWN else near
    return apart <= near and abs(turn) <= ALIGNED_YAW * near / ALIGNED


def _stays_above(scene: Scene, apart: float, turn: float, top: float) -> bool:
    """Return True if moves down of full length leave the fingers above the item until they are aligned."""
    step = scene.max_translation
    moves = max(math.ceil(apart / step - 1e-6), math.ceil(abs(turn) / scene.max_rotation - 1e-6))
    return scene.robot.pose.z - step * moves >= top - 1e-3


def grasp_item(scene: Scene, item: SceneObject, yaw: float, symmetry: float) -> Iterator[Waypoint]:
    """Yield the way to a grasp about an item's centre of mass, over whatever is in between.

    :param yaw: along which the fingers open (rad); the nearest one with room for them is taken
    :param symmetry: turning the gripper by this angle (rad) gives as good a grasp
    """
    hand, centre = scene.robot.pose, item.centre_of_mass
    top = max(scene.world.top(item.body), highest_between(scene, hand.position, centre, item))
    nearest = hand.yaw + wrap_angle(yaw - hand.yaw, symmetry)
    if _is_clear(scene, item, nearest) or "r" not in scene.config.action_sequence:
        yield from grasp(scene, Pose.planar(*centre, nearest), top, symmetry)
    else:
        other = nearest - math.copysign(symmetry, wrap_angle(nearest - hand.yaw))
        yield from grasp(scene, Pose.planar(*centre, other), top, 2.0 * math.pi)


def place_item(
    scene: Scene, item: SceneObject, spot: Sequence[float], height: float, turn: float = 0.0
) -> Iterator[Waypoint]:
    """Yield the way of the held item to a spot, over whatever is in between, and let go of it there.

    The parameters are those of :func:`place_pose`.
    """
    goal = place_pose(scene, item, spot, height, turn)
    yield from _carry(scene, item, goal, height, OPEN, ALIGNED)


def place_pose(
    scene: Scene, item: SceneObject, spot: Sequence[float], height: float, turn: float = 0.0
) -> Pose:
    """Return where the fingertips let go of the held item.

    :param spot: x and y (m) of the item's middle
    :param height: of the item's lowest point (m) when it is let go
    :param turn: by which it is turned on the way (rad); ignored where the gripper cannot turn
    """
    hand = scene.robot.pose
    turn = turn if "r" in scene.config.action_sequence else 0.0
    dx, dy, _ = rotate(Pose.planar(0.0, 0.0, 0.0, turn).orientation, _way(hand, item.pose))
    return Pose.planar(spot[0] - dx, spot[1] - dy, height + hand.z - item.lowest, hand.yaw + turn)


def _carry(
    scene: Scene, item: SceneObject, goal: Pose, height: float, opening: float, near: float
) -> Iterator[Waypoint]:
    """Yield the way to where the held item is let go.

    :param height: of the item's lowest point (m) there
    :param opening: ratio to let go with
    :param near: distance (m) in the plane at which the item may go down
    """
    hand, goal = scene.robot.pose, avoid_limits(scene, goal)
    if not _is_aligned(goal, hand, wrap_angle(goal.yaw - hand.yaw), near):
        over = max(height, highest_between(scene, hand.position, goal.position, item))
        level = min(over + PASSING + hand.z - item.lowest, scene.config.workspace[2][1])
        if hand.z < level - HEIGHT_TOLERANCE:
            yield Waypoint(Pose.planar(hand.x, hand.y, level, hand.yaw), CLOSED)
        yield Waypoint(Pose.planar(goal.x, goal.y, level, goal.yaw), CLOSED)
    yield Waypoint(goal, CLOSED, finish=opening, clear=True)


def _way(start: Pose, end: Pose) -> tuple[float, float, float]:
    return (end.x - start.x, end.y - start.y, 0.0)


def highest_between(
    scene: Scene, start: Sequence[float], end: Sequence[float], but: SceneObject | None
) -> float:
    """Return the height (m) of the highest item but one near a line, or of the ground."""
    reach = scene.robot.model.gripper.half_width() + PASSING_ASIDE
    tops = [
        scene.world.top(item.body)
        for item in scene
        if item is not but
        and not item.spec.is_mark
        and _distance_to_line(item.pose.position, start, end) < item.spec.planar_radius + reach
    ]
    return max(tops, default=scene.surface.height((end[0], end[1])))


def _distance_to_line(point: Sequence[float], start: Sequence[float], end: Sequence[float]) -> float:
    """Return the distance (m) in the plane of a point to the line between two others."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    square = dx * dx + dy * dy
    share = ((point[0] - start[0]) * dx + (point[1] - start[1]) * dy) / square if square > 0.0 else 0.0
    share = min(1.0, max(0.0, share))
    return math.hypot(point[0] - start[0] - share * dx, point[1] - start[1] - share * dy)


def _is_clear(scene: Scene, item: SceneObject, yaw: float) -> bool:
    """Whether no other item is where the open fingers come down."""
    gripper = scene.robot.model.gripper
    reach = (gripper.stroke + gripper.finger[0]) / 2.0
    margin = gripper.finger[1] / 2.0
    x, y, z = item.centre_of_mass
    fingers = [(x + s * reach * math.cos(yaw), y + s * reach * math.sin(yaw), z) for s in (1.0, -1.0)]
    others = [other for other in scene if other is not item and not other.spec.is_mark]
    return not any(_covers(other, finger, margin) for other in others for finger in fingers)


def _covers(item: SceneObject, point: tuple[float, float, float], margin: float) -> bool:
    """Whether a point is in the box of one of an item's pieces, widened by a margin (m)."""
    inside = np.array(item.pose.inverse().transform(point))
    low, high = item.spec.piece_bounds[:, 0] - margin, item.spec.piece_bounds[:, 1] + margin
    return bool(((low < inside) & (inside < high)).all(axis=1).any())


def side_yaw(pose: Pose) -> float:
    """Return the direction (rad) of a box's side that lies flattest, whichever way it has come to lie."""
    rotation = matrix(pose)
    flattest = int(abs(rotation[2]).argmin())
    return math.atan2(rotation[1, flattest], rotation[0, flattest])


def side_symmetry(pose: Pose) -> float:
    """Return the angle (rad) by which a gripper along :func:`side_yaw` can be turned and hold a cube as well.

    On a slope the fingers are square to the flattest side alone.
    """
    second = sorted(abs(matrix(pose)[2]).tolist())[1]
    return math.pi / 2.0 if second < math.sin(SLANTED) else math.pi
