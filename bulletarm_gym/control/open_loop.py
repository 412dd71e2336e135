"""Open-loop control: each action is a whole pick or place (paper, Open-loop Environments)."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from bulletarm_gym.config import OPEN_LOOP, EnvConfig
from bulletarm_gym.config_checks import check_argument, check_fields, choice, instance, numbers
from bulletarm_gym.control.control import Control, GraspParams, Outcome, RobotInterface, grid_positions
from bulletarm_gym.geometry import Pose, Rectangle, Vector, euler_pose, matrix
from bulletarm_gym.observations import ElevationMap, Frame, View
from bulletarm_gym.observations.rasterizer import rectangle_mask

MIN_PICK_HEIGHT = 0.005
"""Smallest height (m) of a pick."""
REMOVED = 0.002
"""Smallest decrease (m) of a pixel's height at a pick that shows the absence of the grasped object."""
GRASP_RADIUS = 0.05
"""Largest distance (m) of the fingertips from the nearest pixel of the grasped object."""


class Grasp(NamedTuple):
    """Measurements of a grasped object at its pick.

    The footprint is a rectangle in the frame of the fingertips, whose x axis is the opening direction.

    :param height: height (m) of the fingertips above the object's lower side
    :param x: middle of the footprint along x (m)
    :param y: middle of the footprint along y (m)
    :param length: side of the footprint along x (m)
    :param width: side of the footprint along y (m)
    """

    height: float
    x: float
    y: float
    length: float
    width: float


def pick_height(
    heights: ElevationMap, target: Pose, depth: float, area: tuple[float, float] | None = None
) -> float:
    """Return the height (m, world) of the fingertips at a pick whose action has no z.

    :param heights: last heightmap
    :param target: pose of the fingertips; its z and tilt do not matter
    :param depth: depth (m) of the fingertips below the highest point of the area
    :param area: length along the opening and width (m) of the area; by default a square of twice the depth
    """
    between = Rectangle(target.x, target.y, *(area or (2.0 * depth, 2.0 * depth)), target.yaw)
    return heights.floor + max(_highest(heights, between) - depth, MIN_PICK_HEIGHT)


def measure_grasp(before: ElevationMap, after: ElevationMap, closed_at: Pose) -> Grasp | None:
    """Return the measurements of the grasped object, or None if the heightmaps do not show its absence.

    The footprint consists of the connected pixels that the pick lowered. The surface that supported the
    object, the floor or another object, is the highest of these pixels after the pick.

    :param before: heightmap before the pick
    :param after: heightmap after the pick, without the grasped object
    :param closed_at: measured pose of the fingertips when they closed
    """
    removed = before.heights - after.heights > REMOVED
    if not removed.any():
        return None
    pixels = np.argwhere(removed)
    distances = np.linalg.norm(pixels - before.pixels(np.array(closed_at.position)), axis=1)
    nearest = int(distances.argmin())
    if distances[nearest] * before.resolution > GRASP_RADIUS:
        return None
    regions, _ = label(removed, np.ones((3, 3)))
    footprint = regions == regions[tuple(pixels[nearest])]
    points = before.points(np.argwhere(footprint)) - closed_at.position[:2]
    points = points @ matrix(Pose.planar(0.0, 0.0, 0.0, closed_at.yaw))[:2, :2]
    (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    height = closed_at.z - after.floor - float(after.heights[footprint].max())
    return Grasp(height, (x0 + x1) / 2.0, (y0 + y1) / 2.0, x1 - x0, y1 - y0)


def place_height(heights: ElevationMap, target: Pose, grasp: Grasp, gap: float) -> float:
    """Return the height (m, world) of the fingertips at a place whose action has no z.

    :param heights: last heightmap, without the grasped object
    :param target: pose of the fingertips; its z and tilt do not matter
    :param grasp: measurements at the pick
    :param gap: distance (m) between the object and the highest point under it
    """
    x, y, _ = Pose.planar(target.x, target.y, 0.0, target.yaw).transform((grasp.x, grasp.y, 0.0))
    footprint = Rectangle(x, y, grasp.length, grasp.width, target.yaw)
    return heights.floor + (_highest(heights, footprint) + grasp.height + gap)


def _highest(heights: ElevationMap, area: Rectangle) -> float:
    """Return the greatest height (m) of the pixels in an area and of the pixel at its middle."""
    covered = rectangle_mask(heights.window, [area])
    row, column = heights.pixels(np.array((area.x, area.y))).round().astype(int).clip(0, len(covered) - 1)
    covered[row, column] = True
    return float(heights.heights[covered].max())


PICK = "pick"
PLACE = "place"

MAX_Z = 0.3
"""Largest height (m) of a target above the workspace's floor."""
MAX_TILT = math.pi / 4.0
"""Largest rotation (rad) about the gripper's y and x axes."""
TILT = math.pi / 12.0
"""Tilt (rad) that must be in reach all over the workspace: the mean slope of ramps."""
TILTED_Z = (0.02, 0.2)
"""Heights (m) above the workspace's floor at which that tilt must be in reach."""
ANGLES = ("theta", "phi", "psi")
"""Names of three r's in an action sequence."""


@dataclass(frozen=True)
class PickPlaceMotion:
    """Distances (m) of the motion of a pick or place.

    The opening is the task's (:class:`GraspParams`). The torques of the joints limit the speeds.

    :param stops: distances from the target to the poses at which the gripper stops; the first entry whose
        poses are in reach counts. An approach begins, and a retreat ends, at the first stop where the gripper
        touches nothing, or at the last
    :param release: opening at a release before the retreat, so that the fingers do not push other objects
    """

    stops: tuple[tuple[float, ...], ...] = ((0.05, 0.1), (0.05,), (0.025,))
    release: float = 0.008

    @property
    def approach(self) -> float:
        """Largest distance (m) from the target to the beginning of an approach."""
        return self.stops[0][-1]


MOTION = PickPlaceMotion()
HALF_TURN = Pose.planar(0.0, 0.0, 0.0, math.pi)
"""Rotation of the gripper that exchanges its fingers."""


@dataclass(frozen=True)
class PickPlace:
    """An open-loop action in physical units.

    :param primitive: ``"pick"`` or ``"place"``
    :param position: of the fingertips (m) in the world
    :param rotation: theta, phi, psi (rad): about z, then about the rotated y, then about the rotated x axis
    :raises ValueError: the primitive is unknown, or a number is not finite
    """

    primitive: str
    position: Vector
    rotation: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        three = numbers(count=3)
        check_fields(self, {"primitive": choice(PICK, PLACE), "position": three, "rotation": three})

    @property
    def pose(self) -> Pose:
        """Pose of the fingertips in the world."""
        theta, phi, psi = self.rotation
        return euler_pose(self.position, (psi, phi, theta))


class OpenLoop(Control[PickPlace]):
    """Pick and place.

    The characters of ``action_sequence`` are p, the primitive (below 0 a pick, else a place), x and y, the
    target's position in the workspace, z, its height above the floor, and the r's, theta, phi and psi.
    Without p the gripper picks if it is empty and places if it holds an object. Without z the height follows
    from heightmaps. Without r the gripper does not rotate.
    """

    kind = OPEN_LOOP

    def __init__(self, config: EnvConfig, robot: RobotInterface, grasp_params: GraspParams) -> None:
        self._config = config
        self._grasp_params = grasp_params
        x, y, (floor, _) = config.workspace
        angles = iter(ANGLES)
        self._names = [next(angles) if name == "r" else name for name in config.action_sequence]
        ranges = {"x": (x[0], x[1]), "y": (y[0], y[1]), "z": (floor, floor + MAX_Z)}
        ranges |= {"theta": (0.0 if config.half_rotation else -math.pi, math.pi)}
        ranges |= dict.fromkeys(("phi", "psi"), (-MAX_TILT, MAX_TILT))
        self.ranges = {name: limits for name, limits in ranges.items() if name in self._names}
        super().__init__(config, robot, _poses(config, floor))

    # Actions

    def decode_action(self, action: ArrayLike, view: View) -> PickPlace:
        value = dict(zip(self._names, self.numbers(action), strict=True))
        at = {
            name: low + (value[name] + 1.0) / 2.0 * (high - low) for name, (low, high) in self.ranges.items()
        }
        theta, phi, psi = (at.get(name, 0.0) for name in ANGLES)
        places = value["p"] >= 0.0 if "p" in value else view.is_holding
        x, y = at["x"], at["y"]
        move = PickPlace(PLACE if places else PICK, (x, y, at.get("z", 0.0)), (theta, phi, psi))
        if "z" in at:
            return move
        return replace(move, position=(x, y, self._height(view, places, self.executed(move))))

    def encode_action(self, move: PickPlace) -> NDArray[np.float32]:
        move = check_argument("move", move, instance(PickPlace))
        theta, phi, psi = move.rotation
        low, high = self.ranges.get("theta", (-math.pi, math.pi))
        if not low <= theta <= high:
            turns, theta = divmod(theta - low, high - low)
            theta += low
            # A rotation by pi exchanges the fingers and reverses the gripper's other axes.
            phi, psi = (-phi, -psi) if self._config.half_rotation and turns % 2.0 else (phi, psi)
        value = dict(zip(("x", "y", "z", *ANGLES), (*move.position, theta, phi, psi), strict=True))
        share = {name: (value[name] - low) / (high - low) for name, (low, high) in self.ranges.items()}
        share["p"] = float(move.primitive == PLACE)
        return np.array([2.0 * share[name] - 1.0 for name in self._names], dtype=np.float32).clip(-1.0, 1.0)

    def _height(self, view: View, places: bool, target: Pose) -> float:
        params, depth = self._grasp_params, self._grasp_params.pick_offset
        if places and view.is_holding:
            # A task may start with a grasped object: without measurements it counts as a cube.
            grasp = Grasp(*(self.memory or (depth, 0.0, 0.0, 2.0 * depth, 2.0 * depth)))
            return place_height(view.elevation_map, target, grasp, params.place_offset)
        return pick_height(view.elevation_map, target, depth, params.pick_area)

    def follow(self, before: View, after: View, outcome: Outcome) -> None:
        """Remember the measurements of the grasped object until the gripper is empty."""
        if not self.robot.is_holding:
            self.memory = None
        elif outcome.closed_at is not None and "z" not in self.ranges:
            grasp = measure_grasp(before.elevation_map, after.elevation_map, outcome.closed_at)
            self.memory = None if grasp is None else tuple(grasp)

    # Motion

    def apply(self, move: PickPlace) -> Outcome:
        """Execute a pick or a place and move to the home pose.

        A pick while holding, a place while empty and a target out of reach are ignored.
        """
        robot, pose, picks = self.robot, self.executed(move), move.primitive == PICK
        stops = self._stops(pose)
        if picks == robot.is_holding or not stops:
            return Outcome(ignored=True)
        if picks:
            self._open(self._grasp_params.opening)
        robot.transfer(*stops)
        robot.move_to(pose)
        closed_at = robot.pose if picks else None
        if picks:
            robot.set_opening(0.0)
        else:
            self._open(robot.opening + MOTION.release)
            robot.wait_until_still()
        self._retreat(stops)
        if not (picks and robot.is_holding):
            self._open(self._grasp_params.opening)
        robot.transfer(self._home)
        return Outcome(ignored=False, pick=move.pose if picks else None, closed_at=closed_at)

    def _stops(self, pose: Pose) -> list[Pose]:
        """Return the poses behind a target at which the gripper stops, nearest first; none out of reach."""
        for distances in MOTION.stops if self.robot.reaches(pose) else ():
            stops = [pose.compose(Pose((0.0, 0.0, distance))) for distance in distances]
            if all(map(self.robot.reaches, stops)):
                return stops
        return []

    def executed(self, move: PickPlace) -> Pose:
        """Return the tool pose of a move, within pi/2 of the home pose under ``half_rotation``.

        The gripper is symmetric, so that its fingers can be exchanged.
        """
        is_far = self._config.half_rotation and move.rotation[0] >= math.pi / 2.0
        return move.pose.compose(HALF_TURN) if is_far else move.pose

    def _retreat(self, stops: Sequence[Pose]) -> None:
        """Move back to the first stop at which the gripper touches nothing, or to the last."""
        for stop in stops:
            if self.robot.pose.inverse().compose(stop).z > 0.0:  # not behind the stop already
                self.robot.move_to(stop, in_contact=False)
            if self.robot.is_apart():
                return

    def _open(self, width: float) -> None:
        """Open the fingers to a distance (m), at most to the stroke."""
        self.robot.set_opening(min(width / self.robot.stroke, 1.0))

    def frame(self) -> Frame:
        return workspace_frame(self._config.workspace)


def workspace_frame(workspace: Sequence[Sequence[float]]) -> Frame:
    """Return a workspace as a frame, from its floor up, without the arm and the grasped object."""
    (x0, x1), (y0, y1), (floor, _) = workspace
    return Frame(Pose(((x0 + x1) / 2.0, (y0 + y1) / 2.0, floor)), x1 - x0, hides_grasped=True)


def _poses(config: EnvConfig, floor: float) -> Iterator[Pose]:
    """Yield the poses at which the reach is checked, none above home; with three r's also tilted ones."""

    def below_home(*heights: float) -> list[float]:
        return [min(floor + height, config.home_height) for height in heights]

    for position in grid_positions(config, below_home(0.0, MOTION.approach, MAX_Z)):
        yield Pose.planar(*position)
    if config.action_sequence.count("r") == len(ANGLES):
        for position in grid_positions(config, below_home(*TILTED_Z), 3):
            for theta, tilt in itertools.product((0.0, math.pi / 2.0), (-TILT, TILT)):
                yield euler_pose(position, (tilt, 0.0, theta))
                yield euler_pose(position, (0.0, tilt, theta))
