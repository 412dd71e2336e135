"""Waypoints of grasps from above and of releases under closed-loop control, shared by the tasks' experts."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, MAX_ROTATION, MAX_TRANSLATION
from bulletarm_gym.control import CloseLoop, Control, DeltaMove, OpenLoop, PickPlace
from bulletarm_gym.control.open_loop import HALF_TURN, MOTION, PICK, PLACE
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose, euler_angles, matrix, planar_distance, rotate, wrap_angle
from bulletarm_gym.scene import Scene, SceneObject

ALIGNED = 0.012
"""Horizontal distance (m) from a target within which the open fingers can descend around an object."""
ALIGNED_YAW = 0.25
"""Yaw (rad) from a target within which the open fingers can descend around an object."""
PRECISE = 0.003
"""Horizontal distance (m) within which closed-loop control descends to an open-loop pick or place."""
HEIGHT_TOLERANCE = 5e-3
"""Height (m) below a waypoint at which the fingertips count as arrived."""
HOVER = 0.03
"""Height (m) of the fingertips above an object while they are aligned with it."""
PASSING = 0.03
"""Gap (m) between the grasped object and objects below its path; wide, for agents that imitate it."""
RELEASE = 0.003
"""Gap (m) below an object at its release."""
AT_LIMIT = 0.03
"""Distance (rad) of the last joint from its limit within which the other joints compensate for its rotation.

Inverse kinematics then ends up to 0.02 rad before the limit, and only at some heights in one straight motion.
"""
WRIST_MARGIN = 1.0
"""Rotation (rad) of the last joint, in addition to the gripper's, as the arm moves across the workspace."""


def route(scene: Scene, move: Waypoint, opening: float) -> Iterator[Waypoint]:
    """Yield closed-loop waypoints to a pick or place: up, above the objects in between, straight down.

    :param move: waypoint with a finish: a pick if that closes the gripper, else a place
    :param opening: largest opening ratio near other objects; a pick may have a smaller one
    """
    assert move.finish is not None
    tool, held, goal = scene.robot.pose, scene.held, move.pose
    if not rotates(scene):
        goal = Pose.planar(*goal.position, tool.yaw)
    if held is None or move.finish < move.gripper:
        top = max(goal.z, highest_between(scene, tool.position, goal.position, held))
        yield from grasp(scene, goal, top, math.pi, min(opening, move.gripper), PRECISE)
    else:
        height = goal.z - tool.z + held.lowest
        apart = scene.robot.opening_ratio + MOTION.release / scene.robot.model.gripper.stroke
        yield from _carry(scene, held, goal, height, min(apart, opening), PRECISE)


def rotates(scene: Scene) -> bool:
    """Return True if actions rotate the gripper."""
    return "r" in scene.config.action_sequence


def exchange_fingers(scene: Scene, pose: Pose) -> Pose:
    """Return a tool pose rotated by pi about the gripper's axis, with the same centre of the grasped object.

    A parallel gripper is symmetric, and so is every object that experts place.
    """
    if scene.held is None:
        return pose.compose(HALF_TURN)
    x, y, _ = scene.robot.pose.inverse().transform(scene.held.pose.position)
    return pose.compose(Pose((x, y, 0.0))).compose(HALF_TURN).compose(Pose((-x, -y, 0.0)))


def avoid_limits(scene: Scene, pose: Pose) -> Pose:
    """Return a tool pose, or the symmetric pose if a joint limit blocks all motions to the first."""
    robot = scene.robot
    if robot.wrist_room() > abs(wrap_angle(pose.yaw - robot.pose.yaw)) + WRIST_MARGIN:
        return pose
    possible = [other for other in (pose, exchange_fingers(scene, pose)) if robot.can_move_to(other)]
    return next((other for other in possible if robot.wrist_room(other) > AT_LIMIT), (*possible, pose)[0])


def grasp(
    scene: Scene, target: Pose, top: float, symmetry: float, opening: float = OPEN, near: float = ALIGNED
) -> Iterator[Waypoint]:
    """Yield the waypoints of a grasp with the empty gripper.

    The path is straight while the fingers stay above the object until they are aligned with it, else up,
    across and down.

    :param target: pose of the fingertips when they close
    :param top: height (m) of the highest point of the object and of all objects on the path
    :param symmetry: angle (rad) between equivalent yaws of the gripper
    :param opening: opening ratio of the approach
    :param near: horizontal distance (m) to the target within which the fingers descend
    """
    tool = scene.robot.pose
    rotation = wrap_angle(target.yaw - tool.yaw, symmetry)
    goal = avoid_limits(scene, Pose.planar(*target.position, tool.yaw + rotation))
    rotation = wrap_angle(goal.yaw - tool.yaw)
    apart = max(abs(goal.x - tool.x), abs(goal.y - tool.y))
    aligned = _is_aligned(goal, tool, rotation, near)
    moves = math.ceil(max(apart / scene.max_translation, abs(rotation) / scene.max_rotation) - 1e-6)
    above = tool.z - scene.max_translation * moves >= top - 1e-3
    ready = scene.robot.opening_ratio > 0.9 * opening
    hover = top + HOVER
    if tool.z < hover - HEIGHT_TOLERANCE and not ((aligned and ready) or above):
        width = opening if tool.z > top else scene.robot.opening_ratio
        yield Waypoint(Pose.planar(tool.x, tool.y, hover, tool.yaw), width)
    closes_at_once = not ready and tool.z - goal.z < scene.max_translation
    if closes_at_once or not (aligned or above):
        yield Waypoint(Pose.planar(goal.x, goal.y, hover, goal.yaw), opening)
    yield Waypoint(goal, opening, finish=CLOSED, clear=True)


def _is_aligned(goal: Pose, tool: Pose, rotation: float, near: float) -> bool:
    """Return True if the fingers can move straight to a goal from within a horizontal distance (m)."""
    near = ALIGNED if tool.z < goal.z + 0.01 else near  # contacts push the fingers
    apart = planar_distance(goal.position, tool.position)
    return apart <= near and abs(rotation) <= ALIGNED_YAW * near / ALIGNED


def grasp_object(scene: Scene, obj: SceneObject, yaw: float, symmetry: float) -> Iterator[Waypoint]:
    """Yield the waypoints of a grasp at an object's centre of mass, above all objects in between.

    :param yaw: direction (rad) in which the fingers open; the nearest equivalent one that is free is used
    :param symmetry: angle (rad) between equivalent yaws of the gripper
    """
    tool, centre = scene.robot.pose, obj.centre_of_mass
    top = max(scene.world.top(obj.body), highest_between(scene, tool.position, centre, obj))
    nearest = tool.yaw + wrap_angle(yaw - tool.yaw, symmetry)
    if _is_clear(scene, obj, nearest) or not rotates(scene):
        yield from grasp(scene, Pose.planar(*centre, nearest), top, symmetry)
    else:
        other = nearest - math.copysign(symmetry, wrap_angle(nearest - tool.yaw))
        yield from grasp(scene, Pose.planar(*centre, other), top, 2.0 * math.pi)


def place_object(
    scene: Scene, obj: SceneObject, spot: Sequence[float], height: float, rotation: float = 0.0
) -> Iterator[Waypoint]:
    """Yield the waypoints that carry the grasped object above all others and release it.

    The parameters are those of :func:`place_pose`.
    """
    goal = place_pose(scene, obj, spot, height, rotation)
    yield from _carry(scene, obj, goal, height, OPEN, ALIGNED)


def place_pose(
    scene: Scene, obj: SceneObject, spot: Sequence[float], height: float, rotation: float = 0.0
) -> Pose:
    """Return the pose of the fingertips that releases the grasped object.

    :param spot: x and y (m) of the object's origin at the release
    :param height: height (m) of the object's lowest point at the release
    :param rotation: rotation (rad) about z before the release; ignored if actions do not rotate the gripper
    """
    tool = scene.robot.pose
    rotation = rotation if rotates(scene) else 0.0
    offset = (obj.pose.x - tool.x, obj.pose.y - tool.y, 0.0)
    dx, dy, _ = rotate(Pose.planar(0.0, 0.0, 0.0, rotation).orientation, offset)
    return Pose.planar(spot[0] - dx, spot[1] - dy, height + tool.z - obj.lowest, tool.yaw + rotation)


def _carry(
    scene: Scene, obj: SceneObject, goal: Pose, height: float, opening: float, near: float
) -> Iterator[Waypoint]:
    """Yield the waypoints to the release of the grasped object, with its lowest point at a height (m)."""
    tool, goal = scene.robot.pose, avoid_limits(scene, goal)
    if not _is_aligned(goal, tool, wrap_angle(goal.yaw - tool.yaw), near):
        over = max(height, highest_between(scene, tool.position, goal.position, obj))
        level = min(over + PASSING + tool.z - obj.lowest, scene.config.workspace[2][1])
        yield from pass_above(tool, Pose.planar(*goal.position, goal.yaw), level)
    yield Waypoint(goal, CLOSED, finish=opening, clear=True)


def pass_above(tool: Pose, goal: Pose, height: float) -> Iterator[Waypoint]:
    """Yield waypoints of the closed gripper: up to a height (m), then across to above a goal."""
    if tool.z < height - HEIGHT_TOLERANCE:
        yield Waypoint(Pose.planar(tool.x, tool.y, height, tool.yaw), CLOSED)
    yield Waypoint(Pose((goal.x, goal.y, height), goal.orientation), CLOSED)


def highest_between(
    scene: Scene, start: Sequence[float], end: Sequence[float], ignored: SceneObject | None
) -> float:
    """Return the height (m) of the highest object near a line except one, or of the surface at its end.

    An object is near if the gap between it and the open gripper would be less than 5 mm.
    """
    reach = scene.robot.model.gripper.half_width() + 0.005
    tops = [
        scene.world.top(obj.body)
        for obj in scene
        if obj is not ignored
        and not obj.spec.is_mark
        and _distance_to_line(obj.pose.position, start, end) < obj.spec.planar_radius + reach
    ]
    return max(tops, default=scene.surface.height((end[0], end[1])))


def _distance_to_line(point: Sequence[float], start: Sequence[float], end: Sequence[float]) -> float:
    dx, dy = end[0] - start[0], end[1] - start[1]
    square = dx * dx + dy * dy
    share = ((point[0] - start[0]) * dx + (point[1] - start[1]) * dy) / square if square > 0.0 else 0.0
    share = min(1.0, max(0.0, share))
    return math.hypot(point[0] - start[0] - share * dx, point[1] - start[1] - share * dy)


def _is_clear(scene: Scene, obj: SceneObject, yaw: float) -> bool:
    """Return True if no other object is below the open fingers at an object."""
    gripper = scene.robot.model.gripper
    reach, margin = (gripper.stroke + gripper.finger[0]) / 2.0, gripper.finger[1] / 2.0
    x, y, z = obj.centre_of_mass
    fingers = [(x + s * reach * math.cos(yaw), y + s * reach * math.sin(yaw), z) for s in (1.0, -1.0)]
    for other in (other for other in scene if other is not obj and not other.spec.is_mark):
        points = np.array([other.pose.inverse().transform(finger) for finger in fingers])[:, None]
        low, high = other.spec.piece_bounds[:, 0] - margin, other.spec.piece_bounds[:, 1] + margin
        if ((low < points) & (points < high)).all(axis=2).any():
            return False
    return True


def side_yaw(pose: Pose) -> float:
    """Return the direction (rad) of a cube's most horizontal axis."""
    rotation = matrix(pose)
    flattest = int(abs(rotation[2]).argmin())
    return math.atan2(rotation[1, flattest], rotation[0, flattest])


def side_symmetry(pose: Pose) -> float:
    """Return the angle (rad) between equivalent yaws of a gripper that grasps a cube along :func:`side_yaw`.

    Vertical fingers slip off sides that are tilted by more than 8 degrees.
    """
    second = sorted(abs(matrix(pose)[2]).tolist())[1]
    return math.pi / 2.0 if second < math.sin(math.radians(8.0)) else math.pi


ARRIVED = 0.999
"""Fraction of the distance to a waypoint from which the gripper counts as arrived."""


class Tracker:
    """Follows plans by the moves of a control.

    :param control: a subclass of ``CloseLoop`` or ``OpenLoop``, or one that defines ``towards(waypoint)``
    :param scene: the scene of the plans; its largest closed-loop step becomes that of the control
    :param opening: largest distance (m) between the open fingers; None if plans contain the path to a pick or
        place, which closed-loop control otherwise adds
    """

    def __init__(self, control: Control[Any], scene: Scene, opening: float | None) -> None:
        self._control = control
        self._scene = scene
        if control.kind == CLOSE_LOOP:
            _, scene.max_translation = control.ranges.get("x", (0.0, MAX_TRANSLATION))
            _, scene.max_rotation = control.ranges.get("r", (0.0, MAX_ROTATION))
        self._opening = None if opening is None else min(opening / control.robot.stroke, OPEN)

    def next_move(self, plan: Iterator[Waypoint]) -> Any:
        """Return the next move of a plan: open-loop, its first pick or place.

        :raises ValueError: the plan has none
        """
        if isinstance(self._control, OpenLoop):
            return self.towards(_first(waypoint for waypoint in plan if waypoint.finish is not None))
        return self.towards(next(self.path(plan)))

    def path(self, plan: Iterator[Waypoint]) -> Iterator[Waypoint]:
        """Yield the waypoints of a closed-loop plan, or those of the path to its first pick or place.

        :raises ValueError: the plan has none
        """
        first = _first(plan)
        if self._opening is not None and first.finish is not None and not first.clear:
            yield from route(self._scene, first, self._opening)
        else:
            yield first
            yield from plan

    def towards(self, waypoint: Waypoint) -> Any:
        """Return the move that brings the gripper closest to a waypoint."""
        control = self._control
        if (towards := getattr(control, "towards", None)) is not None:
            return towards(waypoint)
        if isinstance(control, OpenLoop):
            return self._pick_place(control, waypoint)
        if isinstance(control, CloseLoop):
            return self._delta_move(control, waypoint)
        raise TypeError(
            f"control must extend CloseLoop or OpenLoop, or define towards(waypoint), got {type(control)}"
        )

    def _pick_place(self, control: OpenLoop, waypoint: Waypoint) -> PickPlace:
        assert waypoint.finish is not None
        pose = waypoint.pose
        if self._scene.config.half_rotation and "theta" in control.ranges:
            if not -math.pi / 2.0 <= pose.yaw < math.pi / 2.0:
                pose = exchange_fingers(self._scene, pose)
            if pose.yaw < 0.0:
                pose = pose.compose(HALF_TURN)  # OpenLoop.executed() rotates it back
        elif not control.robot.reaches(pose):
            pose = exchange_fingers(self._scene, pose)
        psi, phi, theta = euler_angles(pose.orientation)
        primitive = PICK if waypoint.finish < waypoint.gripper else PLACE
        return PickPlace(primitive, pose.position, (theta, phi, psi))

    def _delta_move(self, control: CloseLoop, waypoint: Waypoint) -> DeltaMove:
        tool, ranges, goal = control.robot.pose, control.ranges, avoid_limits(self._scene, waypoint.pose)
        target = control.within(goal.position)
        distances = [end - start for end, start in zip(target, tool.position, strict=True)]
        rotation = _rotation(control, tool, goal.yaw) if "r" in ranges else 0.0
        limits = [*(ranges[axis][1] for axis in "xyz"), self._scene.max_rotation]
        excess = max(abs(part) / limit for part, limit in zip((*distances, rotation), limits, strict=True))
        scale = 1.0 / excess if waypoint.straight and excess > 1.0 else 1.0
        parts = (*(scale * distance for distance in distances), rotation)
        x, y, z, r = (min(max(part, -limit), limit) for part, limit in zip(parts, limits, strict=True))
        arrives = excess * ARRIVED <= 1.0
        opening = waypoint.finish if arrives and waypoint.finish is not None else waypoint.gripper
        return DeltaMove(opening, (x, y, z), r)


def _rotation(control: CloseLoop, tool: Pose, yaw: float) -> float:
    """Return the rotation (rad) to a yaw, in the longer direction if a joint limit blocks the shorter one."""
    rotation, (low, high) = wrap_angle(yaw - tool.yaw), control.ranges["r"]
    step = min(max(rotation, low), high)
    if step == rotation or control.robot.can_move_to(Pose.planar(*tool.position, tool.yaw + step)):
        return rotation
    return rotation - math.copysign(2.0 * math.pi, rotation)


def checked_plan(plan: Iterable[Any] | None) -> Iterator[Waypoint]:
    """Yield the waypoints of a task's plan.

    :raises ValueError: the plan yields something else
    """
    for waypoint in plan or ():
        if not isinstance(waypoint, Waypoint):
            raise ValueError(f"plan() of the task must yield Waypoint objects, got {waypoint!r}")
        yield waypoint


def _first(plan: Iterator[Waypoint]) -> Waypoint:
    first = next(plan, None)
    if first is None:
        raise ValueError(
            "plan() of the task must yield a waypoint, and in open loop one with a finish, got none"
        )
    return first
