"""Checks of a robot model."""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.check.machine import Finding
from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WORKSPACES, ParameterError, default_home_height
from bulletarm_gym.control.control import MIN_REACH, MIN_TILTED_REACH
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import FloatArray, Pose, Vector, conjugate, multiply, rotate, yaw_quaternion
from bulletarm_gym.robots import Robot, RobotModel
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.simulation import Camera
from bulletarm_gym.simulation.world import TIME_STEP

Limits = list[list[float]]
"""[low, high] (m) along x, y and, in a workspace, z."""

TILT = math.radians(30.0)
"""Largest tilt (rad) of the paper's 6D tasks."""
YAWS = (-math.pi / 2.0, 0.0, math.pi / 2.0)
"""Rotations (rad) of the gripper about the vertical."""
DIRECTIONS = tuple(np.linspace(-math.pi, math.pi, 8, endpoint=False).tolist())
"""Directions (rad) of the tilt."""
FLOOR, TOPS = 0.01, (0.25, 0.18, 0.12, 0.08)
"""Lower limit and candidates for the upper limit (m) of the largest workspace."""
SIDES = tuple(np.arange(0.8, 0.09, -0.04).round(2).tolist())
"""Candidates (m) for the side length of the largest workspace."""
GRID_STEP = 0.04
"""Distance (m) between two candidates for its position."""


def grid(limits: Limits, heights: Sequence[float], points: int, tilt: float = 0.0) -> Iterator[Pose]:
    """Yield a grid of tool poses at three yaws, upright or tilted (rad) in eight directions.

    :param points: number of positions along x and y
    """
    xs, ys = (np.linspace(low, high, points).tolist() for low, high in limits[:2])
    directions = (0.0,) if tilt == 0.0 else DIRECTIONS
    for x, y, z, yaw, direction in itertools.product(xs, ys, heights, YAWS, directions):
        sine = math.sin(tilt / 2.0)
        tilted = (sine * math.cos(direction), sine * math.sin(direction), 0.0, math.cos(tilt / 2.0))
        yield Pose((x, y, z), multiply(tilted, yaw_quaternion(yaw)))


def largest_workspace(model: RobotModel) -> Limits | None:
    """Return the limits (m) of the largest workspace in front of the base in reach of the upright gripper."""
    length = float(np.linalg.norm(model.chain.frames[1][1:], axis=1).sum())
    x, y, _ = model.base.position
    for top, side in itertools.product(TOPS, SIDES):
        for near in np.arange(x + GRID_STEP, x + length - side, GRID_STEP).round(3).tolist():
            limits = [[near, near + side], [y - side / 2.0, y + side / 2.0], [FLOOR, top]]
            heights = (FLOOR, (FLOOR + top) / 2.0, top)
            if all(model.inverse(pose)[1] <= POSITION_TOLERANCE for pose in grid(limits, heights, 3)):
                return np.round(limits, 3).tolist()  # type: ignore[no-any-return]
    return None


POINTS = 5
"""Number of positions along each side of a workspace."""
HEIGHTS = {CLOSE_LOOP: (0.01, 0.13, 0.25), OPEN_LOOP: (0.02, 0.1, 0.25)}
"""Heights (m) of the fingertips in the default workspaces."""
LOAD = 0.2
"""Mass (kg) of the object in the checks of torques and tracking."""
MIN_MARGIN = 0.2
"""Minimum distance (rad) of a joint from its limits at the home pose."""
MAX_DEVIATION = 5e-3
"""Maximum overlap of links, and error of the fingertips, of their distances and of a motion (m)."""
MAX_ANGLE = 0.05
"""Maximum angle (rad) between the opening direction and the x axis of the tool frame."""
STEP = 0.05
"""Length (m) of the motion whose speed is reported; shorter in a lower workspace."""


class Solution(NamedTuple):
    """Joint positions (n,) rad for a pose, and their error (m or rad) with and without the joint limits."""

    pose: Pose
    joints: FloatArray
    error: float
    pose_error: float

    @property
    def is_solved(self) -> bool:
        """Whether the pose is in reach."""
        return self.error <= POSITION_TOLERANCE


def check_robot(model: RobotModel, workspace: Limits | None = None) -> Iterator[Finding]:
    """Yield the findings on a robot, until one prevents the others.

    :param workspace: limits (m) along x, y and z, by default the workspaces of both controls
    """
    spaces: dict[str, tuple[Limits, Sequence[float]]]
    spaces = {control: (WORKSPACES[control], HEIGHTS[control]) for control in HEIGHTS}
    if workspace is not None:
        low, high = workspace[2]
        spaces = {"workspace": (workspace, (low, (low + high) / 2.0, high))}
    solutions = []
    try:
        for name, where in spaces.items():
            upright, tilted = (_solve(model, grid(*where, POINTS, tilt)) for tilt in (0.0, TILT))
            yield _reach(name, upright, tilted)
            solutions += upright
        yield Finding("largest workspace", f"in reach upright: {largest_workspace(model) or 'none'}")
    except ValueError as error:  # a joint is missing, or the URDF cannot be simulated
        yield Finding("model", str(error), "correct the model or its URDF", fails=True)
        return
    solved = [one for one in solutions if one.is_solved]
    worst = max((one.pose_error for one in solved), default=0.0)
    advice = "check the joints in the URDF"
    yield _measured("inverse kinematics", worst, 1e-3, "m or rad", advice)
    yield _limits(model, solutions, _home(workspace))
    try:
        env = _make(model, workspace)
    except ParameterError as error:
        yield Finding("environment", str(error), "see the lines above", fails=True)
        return
    with closing(env):
        yield _self_collision(env, solved)
        yield _fingertips(env)
        yield _fingers(env)
        yield _static_torques(env.scene.robot, solved)
    for mode, load in itertools.product(("fast", "slow"), (0.0, LOAD)):
        yield _tracking(model, workspace, mode, load)


def _solve(model: RobotModel, poses: Iterable[Pose]) -> list[Solution]:
    found = []
    for pose in poses:
        joints, error = model.inverse(pose)
        reached = model.chain.forward(joints)
        x, y, z, w = multiply(conjugate(pose.orientation), reached.orientation)
        angle = 2.0 * math.atan2(math.hypot(x, y, z), abs(w))
        found.append(Solution(pose, joints, error, max(math.dist(pose.position, reached.position), angle)))
    return found


def _home(workspace: Limits | None) -> Pose:
    limits = workspace or WORKSPACES[CLOSE_LOOP]
    (x0, x1), (y0, y1), _ = limits
    return Pose.planar((x0 + x1) / 2.0, (y0 + y1) / 2.0, default_home_height(CLOSE_LOOP, limits))


def _make(model: RobotModel, workspace: Limits | None, **parameters: Any) -> ManipulationEnv:
    if workspace is not None:
        parameters["workspace"] = workspace
    scale = min(1.0, 0.6 * model.gripper.stroke / 0.05)  # a cube of scale 1 has 5 cm
    parameters |= {"robot": model, "object_scale_range": scale}
    env = gymnasium.make("BulletArm/CloseLoopBlockReaching-v0", **parameters).unwrapped
    env.reset(seed=0)
    return env  # type: ignore[return-value]


def _measured(what: str, value: float, limit: float, unit: str, advice: str) -> Finding:
    """Return a finding that fails, with advice, if a value is above its limit."""
    is_bad = bool(value > limit)
    return Finding(what, f"{value:.2g} {unit} (at most {limit:g})", advice if is_bad else "", is_bad)


def _reach(name: str, upright: list[Solution], tilted: list[Solution]) -> Finding:
    share, tilted_share = (np.mean([one.is_solved for one in found]) for found in (upright, tilted))
    value = (
        f"{share:.0%} in reach upright (at least {MIN_REACH:.0%}), {tilted_share:.0%} tilted by 30 "
        f"degrees (at least {MIN_TILTED_REACH:.0%})"
    )
    advice = "change base or posture, or pass a smaller workspace"
    is_small = share < MIN_REACH or tilted_share < MIN_TILTED_REACH
    return Finding(f"reach, {name}", value, advice if is_small else "", bool(share < MIN_REACH))


def _limits(model: RobotModel, solutions: list[Solution], home: Pose) -> Finding:
    """Report the poses beyond joint limits, and the distance of the joints from their limits at home."""
    (lower, upper), (low, high) = model.chain.limits.T, model.chain.solution_limits.T
    beyond = [one.joints for one in solutions if not one.is_solved and one.pose_error <= POSITION_TOLERANCE]
    limited = Counter(int(np.maximum(low - joints, joints - high).argmax()) for joints in beyond)
    joints, _ = model.inverse(home)
    margins = np.minimum(joints - lower, upper - joints)
    value = (
        f"{len(beyond)} of {len(solutions)} poses are beyond one; at home "
        f"{model.joints[int(margins.argmin())]} is {margins.min():.2f} rad from its limit"
    )
    advice = ""
    if margins.min() < MIN_MARGIN:
        advice = f"change posture or rotate the tool, so that the distance is at least {MIN_MARGIN:g} rad"
    elif limited:
        most = model.joints[limited.most_common(1)[0][0]]
        advice = f"{most} is beyond its limit most often: change base or workspace"
    return Finding("joint limits", value, advice)


def _self_collision(env: ManipulationEnv, solved: Sequence[Solution]) -> Finding:
    """Check that links that are not neighbours stay apart, at the posture and over the workspaces."""
    robot, body, worst, where = env.scene.robot, env.scene.robot.body, 0.0, ""
    names = {-1: "the base", **{index: link.name for index, link in enumerate(body.links)}}
    parents = {index: link.parent for index, link in enumerate(body.links)}
    pairs = [
        (one, two)
        for one, two in itertools.combinations(names, 2)
        if not {one, parents.get(one)} & {parents[two], parents.get(parents[two])}
    ]
    places = {f"{np.round(one.pose.position, 2).tolist()} m": one.joints for one in solved[::POINTS]}
    for place, joints in {"the posture": np.array(robot.model.posture), **places}.items():
        robot.show_joints(joints.tolist())
        for one, two in pairs:
            points = env.scene.world.closest_points(body, body, 0.0, one, two)
            depth = max((-point.distance for point in points), default=0)
            if depth > worst:
                worst, where = depth, f" between {names[one]} and {names[two]} at {place}"
    env.scene.begin()
    advice = "check posture, and that the gripper points away from the arm (flange and tool)"
    return _measured("self-collision", worst, MAX_DEVIATION, f"m{where}", advice)


def _fingertips(env: ManipulationEnv) -> Finding:
    """Check that the fingers end at the tool frame."""
    robot, world = env.scene.robot, env.scene.world
    error = min(world.bounds(robot.body, finger)[0][2] for finger in robot.finger_links) - robot.pose.z
    direction = "back to the arm" if error > 0.0 else "along the approach"
    advice = f"move the tool frame by {1e3 * abs(error):.0f} mm {direction}"
    return _measured("fingertips", abs(error), MAX_DEVIATION, "m from the tool frame", advice)


def _fingers(env: ManipulationEnv) -> Finding:
    """Check the direction in which the fingers open, and the distances between them, closed and open."""
    robot = env.scene.robot
    opened, direction = _between(robot)
    x, y, z = rotate(conjugate(robot.pose.orientation), direction)
    angle = math.atan2(math.hypot(y, z), abs(x))
    env.scene.begin()
    robot.set_opening(0.0)
    closed, _ = _between(robot)
    robot.set_opening(1.0)
    if angle > MAX_ANGLE:
        advice = "rotate the tool frame about z until its x axis is the opening direction"
        return _measured("fingers", angle, MAX_ANGLE, "rad between opening direction and x of tool", advice)
    advice = "correct gripper.stroke, or let the fingers meet where their joints are at 0"
    unit = f"m of error: open {1e3 * opened:.1f} mm, closed {1e3 * closed:.1f} mm"
    error = max(closed, abs(opened - robot.model.gripper.stroke))
    return _measured("fingers", error, MAX_DEVIATION, unit, advice)


def _between(robot: Robot) -> tuple[float, Vector]:
    """Return the distance (m) between the fingers and the direction from one to the other."""
    points = robot.world.closest_points(robot.body, robot.body, 1.0, *robot.finger_links)
    nearest = min(points, key=lambda point: point.distance)
    return max(nearest.distance, 0.0), nearest.normal


def _static_torques(robot: Robot, solved: Sequence[Solution]) -> Finding:
    """Check the fractions of the torques that hold the robot with a load against gravity."""
    still = np.zeros(len(robot.model.joints))
    torques = [robot.dynamics.torques(one.joints, still, still, LOAD) for one in solved] or [still]
    most = np.max(np.abs(torques) / robot.model.torques, axis=0)
    unit = f"of the torque of {robot.model.joints[int(most.argmax())]} for gravity and {LOAD} kg"
    return _measured("torques", most.max(), 0.8, unit, "check force and the masses in the URDF")


def _tracking(model: RobotModel, workspace: Limits | None, mode: str, load: float) -> Finding:
    """Check the distance between commanded and reached tool positions in simulated moves; report speeds."""
    name = f"tracking, {mode}, " + (f"{load} kg" if load else "empty")
    with closing(_make(model, workspace, physics_mode=mode, fast_mode=False)) as env:
        scene, robot, home = env.scene, env.scene.robot, _home(workspace)
        (left, right), _, (low, high) = scene.config.workspace
        if load:
            _grasp(env, load)
        step = min(STEP, (high - low) / 2.0, (right - left) / 2.0)
        robot.move_to(home)
        if load and robot.held is None:
            advice = "see the lines above, or increase gripper.force"
            return Finding(name, f"a cube of {load} kg is not lifted", advice, fails=True)
        worst = speed = acceleration = 0.0
        for x, z in ((0.0, -step), (0.0, 0.0), (step, 0.0), (0.0, 0.0)):
            goal = Pose.planar(home.x + x, home.y, home.z + z, home.yaw)
            if not robot.can_move_to(goal):
                continue
            scene.begin()
            steps, rise = robot.duration([robot.inverse_kinematics(goal)], step, in_contact=False)
            seconds = steps * TIME_STEP
            speed = max(speed, 2.0 * step / seconds)
            acceleration = max(acceleration, 2.0 * step / (rise * seconds**2))
            robot.move_to(goal, in_contact=False)
            worst = max(worst, math.dist(robot.pose.position, goal.position))
    advice = "increase force to the torques of the data sheet, or check the masses in the URDF"
    unit = f"m of error at up to {speed:.2f} m/s and {acceleration:.0f} m/s^2"
    return _measured(name, worst, MAX_DEVIATION, unit, advice)


def _grasp(env: ManipulationEnv, load: float) -> None:
    """Close the gripper on the cube, its mass set to a load (kg)."""
    scene, robot, cube = env.scene, env.scene.robot, env.scene["cube"]
    cube.set_properties(mass=load)
    poses = (cube.pose.compose(Pose.planar(0.0, 0.0, 0.0, turn * math.pi / 2.0)) for turn in range(4))
    pose = next((pose for pose in poses if robot.reaches(pose)), None)
    if pose is not None:
        robot.home(Pose.planar(*pose.position, pose.yaw))
        scene.begin()
        robot.set_opening(0.0)


def draw(model: RobotModel, workspace: Limits | None, path: Path) -> None:
    """Write an image of the robot at home with the axes of the tool frame, x red, y green, z blue."""
    with closing(_make(model, workspace)) as env:
        pose, camera = env.scene.robot.pose, Camera()
        image = Image.fromarray(camera.color(env.scene.world))
        lines = ImageDraw.Draw(image)
        for colour, (x, y, z) in zip(("red", "green", "blue"), (0.1 * np.eye(3)).tolist(), strict=True):
            ends = pose.position, pose.transform((x, y, z))
            lines.line([*map(camera.project, ends)], fill=colour, width=3)
        image.save(path)
