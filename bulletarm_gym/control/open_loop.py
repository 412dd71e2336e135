"""Open-loop control: each action is a whole pick or place (paper, Open-loop Environments)."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import OPEN_LOOP, EnvConfig
from bulletarm_gym.control.control import POINTS, Control, Outcome, over
from bulletarm_gym.experts.approach import HALF_TURN, LET_GO, exchange_fingers
from bulletarm_gym.experts.waypoints import APPROACH, OPEN, Waypoint
from bulletarm_gym.geometry import Pose, Rectangle, Vector, euler_angles, euler_pose, matrix
from bulletarm_gym.rendering.overlays import rectangle_mask
from bulletarm_gym.robots import Robot
from bulletarm_gym.scene import Scene
from bulletarm_gym.sensors import Frame, Map, View
from bulletarm_gym.tasks import Task

PICK = "pick"
PLACE = "place"

MAX_Z = 0.3
"""Greatest height (m) of a target above the workspace's floor."""
LEAST_Z = 0.005
"""Least height (m) of a pick where the action gives none."""
MAX_TILT = math.pi / 4.0
"""Greatest turn (rad) about the gripper's y and x axes."""
TILT = math.pi / 12.0
"""The mean slope of ramps (rad), by which ..."""
TILTED_Z = (0.02, 0.2)
"""... the gripper must be able to tilt over the whole workspace, at these heights (m) above its floor."""
STOPS = ((0.05, APPROACH), (0.05,), (0.025,))
"""Distances (m) behind the target at which the gripper stops; the first that are in reach are used.

An approach begins at the last. A retreat ends at the first where the gripper touches nothing.
"""
HOME_HEIGHT = 0.4
"""Height (m) of the fingertips above the workspace's floor between actions: over everything."""
ANGLES = ("theta", "phi", "psi")


@dataclass(frozen=True)
class PickPlace:
    """An open-loop action in physical units.

    :param primitive: ``"pick"`` or ``"place"``
    :param position: of the fingertips (m) in the world
    :param rotation: theta, phi, psi (rad): about z, then about the turned y, then about the turned x axis
    """

    primitive: str
    position: Vector
    rotation: Vector = (0.0, 0.0, 0.0)

    @property
    def pose(self) -> Pose:
        """Of the fingertips in the world."""
        theta, phi, psi = self.rotation
        return euler_pose(self.position, (psi, phi, theta))


class OpenLoop(Control[PickPlace]):
    """Pick and place.

    Of an action p is the primitive (below 0 a pick, else a place), x and y are the target's place in the
    workspace, z is its height above the floor, and the r's are theta, phi and psi. Without p the gripper
    picks when it is empty and places when it holds something; without z the height follows from the
    heightmap; without r the gripper is not turned.

    :param config: the environment's parameters
    :param scene: what is acted on
    :param task: its hints say how to grasp and to let go
    """

    kind = OPEN_LOOP

    def __init__(self, config: EnvConfig, scene: Scene, task: Task) -> None:
        floor = config.workspace[2][0]
        super().__init__(
            config, scene, Pose.planar(*config.centre, floor + HOME_HEIGHT), _extremes(config, floor)
        )
        self._hints = task.hints
        self._config = config
        self._floor = floor
        self._names = _names(config.action_sequence)
        self.ranges = _ranges(config)

    # Actions

    def decode_action(self, action: ArrayLike, view: View) -> PickPlace:
        """Return what an action means at present; numbers outside [-1, 1] are clipped.

        :param view: what was seen last

        :raises ValueError: the action has the wrong shape or is not finite
        """
        value = dict(zip(self._names, self.numbers(action), strict=True))
        at = {
            name: low + (value[name] + 1.0) / 2.0 * (high - low) for name, (low, high) in self.ranges.items()
        }
        theta, phi, psi = (at.get(name, 0.0) for name in ANGLES)
        places = value["p"] >= 0.0 if "p" in value else view.scene.robot.held is not None
        x, y = at["x"], at["y"]
        z = at["z"] if "z" in at else self._height(view, places, x, y, theta)
        return PickPlace(PLACE if places else PICK, (x, y, z), (theta, phi, psi))

    def encode_action(self, move: PickPlace) -> NDArray[np.float32]:
        """Return the action for a move, the inverse of :meth:`decode_action`; what is too far is clipped.

        :raises ValueError: there is no such primitive
        """
        if move.primitive not in (PICK, PLACE):
            raise ValueError(f"primitive: got {move.primitive!r}, takes {PICK!r} or {PLACE!r}")
        theta, phi, psi = move.rotation
        low, high = self.ranges.get("theta", (-math.pi, math.pi))
        if not low <= theta <= high:
            turns, theta = divmod(theta - low, high - low)
            theta += low
            # After half a turn the gripper is the same, but its other axes point the other way.
            phi, psi = (-phi, -psi) if self._config.half_rotation and turns % 2.0 else (phi, psi)
        value = dict(zip(("x", "y", "z", *ANGLES), (*move.position, theta, phi, psi), strict=True))
        share = {name: (value[name] - low) / (high - low) for name, (low, high) in self.ranges.items()}
        share["p"] = float(move.primitive == PLACE)
        return np.array([2.0 * share[name] - 1.0 for name in self._names], dtype=np.float32).clip(-1.0, 1.0)

    def _height(self, view: View, places: bool, x: float, y: float, theta: float) -> float:
        """Return the height (m) of a target that the action gives none for, from what the heightmap shows."""
        held, depth = view.scene.held, self._hints.pick_offset
        if not places or held is None:
            area = self._hints.pick_area or (2.0 * depth, 2.0 * depth)
            top = self._highest(view.map, Rectangle(x, y, *area, theta))
            return max(top - depth, self._floor + LEAST_Z)
        carried = view.scene.robot.pose.inverse().compose(held.pose)
        vertices = held.spec.mesh.vertices @ matrix(carried).T + carried.position
        low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
        middle = ((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, 0.0)
        over = Pose.planar(x, y, 0.0, theta).transform(middle)
        area = (high[0] - low[0], high[1] - low[1])
        top = self._highest(view.map, Rectangle(over[0], over[1], *area, theta))
        return float(top - low[2] + self._hints.place_offset)

    def _highest(self, view: Map, rectangle: Rectangle) -> float:
        """Return the greatest height (m) in a rectangle, at least at its middle."""
        covered = rectangle_mask(view.centre, view.extent, len(view.heights), [rectangle])
        row, column = (
            view.pixels(np.array((rectangle.x, rectangle.y))).round().astype(int).clip(0, len(covered) - 1)
        )
        covered[row, column] = True
        return self._floor + float(view.heights[covered].max())

    # Motion

    def apply(self, scene: Scene, move: PickPlace) -> Outcome:
        """Carry out a pick or a place and bring the gripper home.

        A pick while holding, a place while empty and what is out of reach are ignored.
        """
        robot, pose = scene.robot, self._executed(move)
        stops = self._stops(robot, pose)
        if (move.primitive == PICK) == (robot.held is not None) or not stops:
            return Outcome(ignored=True)
        act = self._pick if move.primitive == PICK else self._place
        act(scene, pose, stops)
        robot.transfer(self._home)
        return Outcome(ignored=False, pick=move.pose if move.primitive == PICK else None)

    def _stops(self, robot: Robot, pose: Pose) -> list[Pose]:
        """Return the poses behind a target at which the gripper stops, the nearest first.

        They are nearer to the target where the arm does not reach as far. The list is empty if the target is
        out of reach.
        """
        if not robot.reaches(pose):
            return []
        for distances in STOPS:
            stops = [pose.compose(Pose((0.0, 0.0, distance))) for distance in distances]
            if all(map(robot.reaches, stops)):
                return stops
        return []

    def _executed(self, move: PickPlace) -> Pose:
        """Return the tool pose of a move, within a quarter turn of the home pose under ``half_rotation``.

        The gripper is symmetric, and the wrist has room to either side.
        """
        is_far = self._config.half_rotation and move.rotation[0] >= math.pi / 2.0
        return move.pose.compose(HALF_TURN) if is_far else move.pose

    def _pick(self, scene: Scene, pose: Pose, stops: Sequence[Pose]) -> None:
        robot = scene.robot
        self._open(robot, self._hints.opening)
        robot.transfer(stops[-1])
        robot.move_to(pose)
        robot.close()
        self._withdraw(robot, stops)
        if robot.held is None:
            self._open(robot, self._hints.opening)

    def _place(self, scene: Scene, pose: Pose, stops: Sequence[Pose]) -> None:
        robot = scene.robot
        robot.transfer(stops[-1])
        robot.move_to(pose)
        self._open(robot, robot.opening + LET_GO)
        scene.settle()
        self._withdraw(robot, stops)
        self._open(robot, self._hints.opening)

    def _withdraw(self, robot: Robot, stops: Sequence[Pose]) -> None:
        """Go back to the first stop where nothing is touched, or to the last.

        A gripper that was blocked on the way in may not have come as far as a stop.
        """
        for stop in stops:
            if robot.pose.inverse().compose(stop).z > 0.0:
                robot.move_to(stop, careful=False)
            if robot.is_apart():
                return

    def _open(self, robot: Robot, width: float) -> None:
        """Open the fingers to a distance (m), as far as they can."""
        robot.set_opening(min(width / robot.model.gripper.stroke, OPEN))

    # Experts

    def next_move(self, scene: Scene, plan: Iterator[Waypoint]) -> PickPlace:
        """Return the first pick or place of a plan."""
        return self.towards(scene, next(waypoint for waypoint in plan if waypoint.finish is not None))

    def towards(self, scene: Scene, waypoint: Waypoint) -> PickPlace:
        """Return the pick or place that a waypoint with a finish stands for."""
        assert waypoint.finish is not None
        pose = waypoint.pose
        if self._config.half_rotation and "theta" in self._names:
            if not -math.pi / 2.0 <= pose.yaw < math.pi / 2.0:
                pose = exchange_fingers(scene, pose)
            if pose.yaw < 0.0:
                pose = pose.compose(HALF_TURN)  # executed without it
        elif not scene.robot.reaches(pose):
            pose = exchange_fingers(scene, pose)
        psi, phi, theta = euler_angles(pose.orientation)
        return PickPlace(
            PICK if waypoint.finish < waypoint.gripper else PLACE, pose.position, (theta, phi, psi)
        )

    # Observation

    def frame(self, scene: Scene) -> Frame:
        """Return the workspace, from its floor up, without the arm and what it holds."""
        origin = Pose((*self._config.centre, self._floor))
        return Frame(origin, self._config.workspace_size, without=scene.robot.held)


def _extremes(config: EnvConfig, floor: float) -> Iterator[Pose]:
    """Yield the poses at which the arm's reach is checked: upright, and tilted if the action sequence tilts.

    An action whose pose is out of reach is ignored.
    """
    for position in over(config, (floor, floor + APPROACH, floor + MAX_Z), POINTS):
        yield Pose.planar(*position)
    if config.action_sequence.count("r") == len(ANGLES):
        for position in over(config, (floor + TILTED_Z[0], floor + TILTED_Z[1]), 3):
            for theta, tilt in itertools.product((0.0, math.pi / 2.0), (-TILT, TILT)):
                yield euler_pose(position, (tilt, 0.0, theta))
                yield euler_pose(position, (0.0, tilt, theta))


def _names(sequence: str) -> list[str]:
    """Return what each number of an action is; the r's are angles in their order."""
    angles = iter(ANGLES)
    return [next(angles) if character == "r" else character for character in sequence]


def _ranges(config: EnvConfig) -> dict[str, tuple[float, float]]:
    """Return what an action's numbers range over (m or rad)."""
    (x0, x1), (y0, y1), (floor, _) = config.workspace
    everything = {
        "x": (x0, x1),
        "y": (y0, y1),
        "z": (floor, floor + MAX_Z),
        "theta": (0.0 if config.half_rotation else -math.pi, math.pi),
        "phi": (-MAX_TILT, MAX_TILT),
        "psi": (-MAX_TILT, MAX_TILT),
    }
    names = _names(config.action_sequence)
    return {name: limits for name, limits in everything.items() if name in names}
