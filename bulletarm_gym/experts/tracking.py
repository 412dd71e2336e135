"""Moves of a control that follow an expert's plan."""

import math
from collections.abc import Callable, Iterator
from typing import Any

from bulletarm_gym.config import CLOSE_LOOP, MAX_ROTATION, MAX_TRANSLATION
from bulletarm_gym.control import CloseLoop, Control, DeltaMove, OpenLoop, PickPlace
from bulletarm_gym.control.open_loop import HALF_TURN, PICK, PLACE
from bulletarm_gym.experts import OPEN, Waypoint
from bulletarm_gym.experts.approach import avoid_limits, exchange_fingers, route
from bulletarm_gym.geometry import Pose, euler_angles, wrap_angle
from bulletarm_gym.scene import Scene

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
        self._towards: Callable[[Waypoint], Any] | None = getattr(control, "towards", None)
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
        first = _first(plan)
        if self._opening is not None and first.finish is not None and not first.clear:
            first = next(route(self._scene, first, self._opening))
        return self.towards(first)

    def towards(self, waypoint: Waypoint) -> Any:
        """Return the move that brings the gripper closest to a waypoint."""
        control = self._control
        if self._towards is not None:
            return self._towards(waypoint)
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


def _first(plan: Iterator[Waypoint]) -> Waypoint:
    first = next(plan, None)
    if first is None:
        raise ValueError(
            "plan() of the task must yield a waypoint, and in open loop one with a finish, got none"
        )
    return first
