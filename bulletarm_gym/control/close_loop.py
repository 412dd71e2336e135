"""Close-loop control: each action moves the gripper a little (paper, Close-loop Environments)."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig
from bulletarm_gym.control.control import MAX_HEIGHT, POINTS, Control, holding, over
from bulletarm_gym.experts.approach import route
from bulletarm_gym.experts.waypoints import OPEN, Waypoint
from bulletarm_gym.geometry import Pose, Vector, wrap_angle
from bulletarm_gym.robots import OutOfReachError
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors.overlays import fill_rectangles, rectangle_mask
from bulletarm_gym.tasks import Task

MAX_TRANSLATION = 0.05
"""Farthest move (m) along an axis (paper, Close-Loop 4D Benchmark)."""
MAX_ROTATION = math.pi / 4.0
"""Farthest turn (rad) about z (paper, Close-Loop 4D Benchmark)."""
VIEW_SCALE = 1.5
"""Side of the observed square in workspaces: 0.45 m for 0.3 m (paper, Benchmark Details)."""
CAMERA_OFFSET = 0.1
"""Height (m) of the virtual camera plane above the fingertips."""
START_HEIGHT = 0.2
"""Height (m) of the fingertips over the workspace's centre at reset, as in the original BulletArm release."""
SQUARE = 0.021
"""Side (m) of the squares that stand for the fingers: 6 of 128 pixels over 0.45 m."""
POSE_SIZE = 8
"""Numbers an item has in the state: presence, position, quaternion."""
ARRIVED = 0.999
"""Share of the way to a waypoint that counts as all of it."""


@dataclass(frozen=True)
class DeltaMove:
    """A close-loop action in physical units.

    :param opening: gripper opening ratio, 0 closed to 1 open
    :param translation: of the fingertips (m), along the world's axes
    :param rotation: of the gripper about z (rad)
    """

    opening: float
    translation: Vector
    rotation: float = 0.0


class CloseLoop(Control[DeltaMove]):
    """Delta-pose control.

    An action is one number in [-1, 1] a character of ``action_sequence``: p the opening (-1 closed, +1 open),
    x, y and z the translation, r the rotation; without r the gripper does not turn.

    :param config: the environment's parameters
    :param scene: what is acted on
    :param task: shows in the image what else there is to see
    """

    kind = CLOSE_LOOP

    def __init__(self, config: EnvConfig, scene: Scene, task: Task) -> None:
        height = min(max(START_HEIGHT, config.workspace[2][0]), config.workspace[2][1])
        extremes = (Pose.planar(*position) for position in over(config, config.workspace[2], POINTS))
        super().__init__(config, scene, Pose.planar(*config.centre, height), extremes)
        self._overlays = task.overlays
        self._finds_way = task.plans_moves
        self._opening = min(task.hints.opening / scene.robot.model.gripper.stroke, OPEN)
        self._workspace = config.workspace
        self._size = config.obs_size
        self._extent = VIEW_SCALE * config.workspace_size
        self._observe = self._image if config.observation == "image" else self._state
        self.observation_space = spaces.Dict(
            {
                **self._own_spaces(config, scene),
                "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
            }
        )

    def _own_spaces(self, config: EnvConfig, scene: Scene) -> dict[str, spaces.Box]:
        if config.observation == "image":
            return {"heightmap": spaces.Box(0.0, MAX_HEIGHT, (1, self._size, self._size), np.float32)}
        size = 6 + sum(POSE_SIZE + len(item.spec.slides) for item in scene.items)
        return {"state": spaces.Box(-np.inf, np.inf, (size,), np.float32)}

    def decode_action(self, action: ArrayLike) -> DeltaMove:
        """Return what an action means; numbers outside [-1, 1] are clipped.

        :raises ValueError: the action has the wrong shape or is not finite
        """
        value = dict(zip(self.sequence, self.numbers(action), strict=True))
        x, y, z = (MAX_TRANSLATION * value[axis] for axis in "xyz")
        return DeltaMove((value["p"] + 1.0) / 2.0, (x, y, z), MAX_ROTATION * value.get("r", 0.0))

    def encode_action(self, move: DeltaMove) -> NDArray[np.float32]:
        """Return the action for a move, the inverse of :meth:`decode_action`; what is too far is clipped."""
        value = dict(zip("xyz", (part / MAX_TRANSLATION for part in move.translation), strict=True))
        value |= {"p": 2.0 * move.opening - 1.0, "r": move.rotation / MAX_ROTATION}
        return np.array([value[axis] for axis in self.sequence], dtype=np.float32).clip(-1.0, 1.0)

    def apply(self, scene: Scene, move: DeltaMove) -> bool:
        """Carry out a move: the arm first, then the gripper.

        :return: whether the move was ignored, being out of reach: in a workspace that was checked hardly ever
        """
        hand = scene.robot.pose
        x, y, z = self.within(map(sum, zip(hand.position, move.translation, strict=True)))
        return self.go(scene, Pose.planar(x, y, z, hand.yaw + move.rotation), move.opening)

    def within(self, position: Iterable[float]) -> Vector:
        """Return the point (m) of the workspace that is nearest to a position."""
        limits = zip(position, self._workspace, strict=True)
        x, y, z = (min(max(value, low), high) for value, (low, high) in limits)
        return (x, y, z)

    def go(self, scene: Scene, pose: Pose, opening: float) -> bool:
        """Bring the fingertips to a pose, then the gripper to an opening ratio.

        :return: whether the pose is out of reach, and nothing was done
        """
        try:
            scene.robot.move_to(pose)
        except OutOfReachError:
            return True
        scene.robot.set_opening(opening)
        return False

    def next_move(self, scene: Scene, plan: Iterator[Waypoint]) -> DeltaMove:
        """Return the move towards the first waypoint of a plan, or on the way to its pick or place."""
        first = next(plan)
        if self._finds_way and first.finish is not None and not first.clear:
            first = next(route(scene, first, self._opening))
        return self.towards(scene, first)

    def towards(self, scene: Scene, waypoint: Waypoint) -> DeltaMove:
        """Return the move that brings the gripper closest to a waypoint."""
        hand = scene.robot.pose
        target = self.within(waypoint.pose.position)
        way = [goal - now for goal, now in zip(target, hand.position, strict=True)]
        turn = wrap_angle(waypoint.pose.yaw - hand.yaw)
        excess = max(*(abs(part) / MAX_TRANSLATION for part in way), abs(turn) / MAX_ROTATION)
        scale = 1.0 / excess if waypoint.straight and excess > 1.0 else 1.0
        x, y, z = (min(max(part * scale, -MAX_TRANSLATION), MAX_TRANSLATION) for part in way)
        arrives = excess * ARRIVED <= 1.0 or (
            "r" not in self.sequence and max(map(abs, way)) <= MAX_TRANSLATION
        )
        opening = waypoint.finish if arrives and waypoint.finish is not None else waypoint.gripper
        return DeltaMove(opening, (x, y, z), min(max(turn, -MAX_ROTATION), MAX_ROTATION))

    def observe(self, scene: Scene) -> dict[str, NDArray[np.float32]]:
        """Return the observation: an image or the poses, and whether the gripper holds something."""
        return {**self._observe(scene), "holding": holding(scene)}

    def _image(self, scene: Scene) -> dict[str, NDArray[np.float32]]:
        """Depth below a plane over the fingertips, the gripper as two squares.

        The image is centred on the fingertips and keeps the world's axes: rows grow with x, columns with y.
        """
        hand = scene.robot.pose
        centre = (hand.x, hand.y)
        heights = scene.heights(centre, self._extent, self._size)
        for overlay in self._overlays(scene):
            covered = rectangle_mask(centre, self._extent, self._size, [overlay.rectangle])
            heights[covered] += np.float32(overlay.rise)
        depth = np.clip(np.float32(hand.z + CAMERA_OFFSET) - heights, 0.0, MAX_HEIGHT)
        fill_rectangles(depth, centre, self._extent, gripper_squares(hand, scene.robot.opening), 0.0)
        return {"heightmap": depth[None]}

    def _state(self, scene: Scene) -> dict[str, NDArray[np.float32]]:
        """Gripper: opening ratio, position (m), cosine and sine of the yaw.

        Then for each item 1 if it is present, its position (m) and its quaternion; zeros if it is not; and
        the displacement (m) of each of its sliding parts.
        """
        hand = scene.robot.pose
        numbers = [scene.robot.opening_ratio, *hand.position, math.cos(hand.yaw), math.sin(hand.yaw)]
        for item in scene.items:
            pose = item.pose
            numbers += [1.0, *pose.position, *pose.orientation] if item.is_present else [0.0] * POSE_SIZE
            numbers += item.joints if item.spec.slides else ()
        return {"state": np.array(numbers, dtype=np.float32)}


def gripper_squares(hand: Pose, opening: float) -> NDArray[np.float64]:
    """Return the rectangles (2, 5) that stand for the fingers, inner sides ``opening`` (m) apart, turned."""
    offset = (opening + SQUARE) / 2.0
    x, y = offset * math.cos(hand.yaw), offset * math.sin(hand.yaw)
    return np.array(
        [[hand.x + sign * x, hand.y + sign * y, SQUARE, SQUARE, hand.yaw] for sign in (1.0, -1.0)]
    )
