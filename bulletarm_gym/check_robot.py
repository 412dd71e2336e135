"""Check an arm: ``python -m bulletarm_gym.check_robot NAME``.

NAME is a built-in arm or the import path ``module:attribute`` of a model, as for the parameter ``robot``.
"""

import argparse
import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WORKSPACES, ParameterError, default_home_height
from bulletarm_gym.control.control import MIN_REACH, MIN_TILTED_REACH
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, Vector, conjugate, rotate
from bulletarm_gym.robots import Robot, RobotModel, find_robot
from bulletarm_gym.robots.reach import (
    TILT,
    Limits,
    ReachStudy,
    grid,
    largest_workspace,
    pose_error,
    study_reach,
)
from bulletarm_gym.selfcheck import Finding, report
from bulletarm_gym.simulation import Camera, World
from bulletarm_gym.simulation.world import TIME_STEP

REACHING = "BulletArm/CloseLoopBlockReaching-v0"
POINTS = 5
"""Number of positions along each side of a workspace."""
HEIGHTS = {CLOSE_LOOP: (0.01, 0.13, 0.25), OPEN_LOOP: (0.02, 0.1, 0.25)}
"""Heights (m) of the fingertips in the default workspaces."""
LOAD = 0.2
"""Mass (kg) of the object in the checks of torques and tracking."""
CUBE = 0.05
"""Side length (m) of a cube of scale 1; the grasped cube takes at most :data:`CUBE_SHARE` of the stroke."""
CUBE_SHARE = 0.6
MAX_ERROR = 1e-3
"""Maximum error (m or rad) of inverse kinematics."""
MIN_ROOM = 0.2
"""Minimum distance (rad) of a joint from its limits at home."""
MAX_COLLISION = 5e-3
"""Maximum overlap (m) of links that are not neighbours."""
MAX_TIP_ERROR = 5e-3
"""Maximum distance (m) between the tool frame and the lowest point of the fingers."""
MAX_TRACKING = 5e-3
"""Maximum distance (m) between a commanded and a reached tool position."""
MAX_STATIC = 0.8
"""Maximum share of a joint's torque that gravity may take."""
MAX_GAP = 5e-3
"""Maximum error (m) of the distance between closed and between open fingers."""
MAX_ANGLE = 0.05
"""Maximum angle (rad) between the opening direction and the x axis of the tool frame."""
STEP = 0.05
"""Length (m) of the closed-loop step whose speed is reported; shorter in a lower workspace."""


def check_robot(model: RobotModel, workspace: Limits | None = None) -> Iterator[Finding]:
    """Yield the findings on an arm; the last one says why no environment can be made with it, if so.

    :param model: the arm
    :param workspace: limits (m) along x, y and z; the default workspaces of both controls by default
    """
    try:
        studies = _studies(model, workspace)
    except ValueError as error:  # a joint is missing, or a number of joint positions or torques is wrong
        yield Finding("model", " ".join(str(error).split()), "correct the model or its URDF", fails=True)
        return
    for name, (upright, tilted) in studies.items():
        yield reach(name, upright, tilted)
    yield Finding("largest workspace", f"in reach upright: {largest_workspace(model)}")
    solved = [one for upright, _ in studies.values() for one in upright.solved]
    yield accuracy(model, solved)
    yield limits(model, [upright for upright, _ in studies.values()], _home(workspace))
    try:
        env = _make(model, workspace)
    except ParameterError as error:
        yield Finding("environment", " ".join(str(error).split()), "see the lines above", fails=True)
        return
    with closing(env):
        yield collisions(env, solved)
        yield from (check(env) for check in (fingertips, fingers))
        yield static_torques(env, solved)
    for mode, load in itertools.product(("fast", "slow"), (0.0, LOAD)):
        yield tracking(model, workspace, mode, load)


def _studies(model: RobotModel, workspace: Limits | None) -> dict[str, tuple[ReachStudy, ReachStudy]]:
    """Return the poses in reach, upright and tilted, by the name of the workspace."""
    asked = {control: (WORKSPACES[control], HEIGHTS[control]) for control in (CLOSE_LOOP, OPEN_LOOP)}
    if workspace is not None:
        asked = {"workspace": (workspace, _heights(workspace))}  # type: ignore[dict-item]
    return {
        name: (study_reach(model, grid(*where, POINTS)), study_reach(model, grid(*where, POINTS, TILT)))
        for name, where in asked.items()
    }


def _heights(workspace: Limits) -> tuple[float, ...]:
    low, high = workspace[2]
    return (low, (low + high) / 2.0, high)


def _home(workspace: Limits | None) -> Pose:
    limits = [list(side) for side in workspace or WORKSPACES[CLOSE_LOOP]]
    (x0, x1), (y0, y1), _ = limits
    return Pose.planar((x0 + x1) / 2.0, (y0 + y1) / 2.0, default_home_height(CLOSE_LOOP, limits))


def _make(model: RobotModel, workspace: Limits | None, **parameters: Any) -> ManipulationEnv:
    if workspace is not None:
        parameters["workspace"] = [list(side) for side in workspace]
    scale = min(1.0, CUBE_SHARE * model.gripper.stroke / CUBE)
    env = gymnasium.make(REACHING, robot=model, object_scale_range=scale, **parameters).unwrapped
    env.reset(seed=0)
    return env  # type: ignore[return-value]


def reach(name: str, upright: ReachStudy, tilted: ReachStudy) -> Finding:
    """Check the share of a workspace that is in reach."""
    value = f"{upright.share:.0%} in reach upright, {tilted.share:.0%} tilted by 30 degrees"
    advice = "change base or posture (tools/reach.py compares bases), or pass a smaller workspace"
    is_small = upright.share < MIN_REACH or tilted.share < MIN_TILTED_REACH
    return Finding(f"reach, {name}", value, advice if is_small else "", upright.share < MIN_REACH)


def accuracy(model: RobotModel, solved: Sequence[tuple[Pose, Any]]) -> Finding:
    """Check that forward kinematics returns the poses that inverse kinematics was solved for."""
    errors = [max(pose_error(model.chain.forward(joints), pose)) for pose, joints in solved]
    worst = max(errors, default=0.0)
    advice = "check the axes and frames of the joints in the URDF"
    bad = worst > MAX_ERROR
    return Finding("inverse kinematics", f"error of at most {worst:.1e} m or rad", advice if bad else "", bad)


def limits(model: RobotModel, studies: Sequence[ReachStudy], home: Pose) -> Finding:
    """Report the joint limits that are met, and the room that the joints have at home."""
    joints, _ = model.inverse(home)
    lower, upper = model.chain.limits.T
    rooms = np.minimum(joints - lower, upper - joints)
    nearest = int(rooms.argmin())
    met = sum((found.limited for found in studies), start=type(studies[0].limited)())
    count = sum(found.count for found in studies)
    value = (
        f"{met.total()} of {count} poses are beyond one; at home {model.joints[nearest]} has the least room"
    )
    advice = ""
    if rooms[nearest] < MIN_ROOM:
        advice = f"change posture, or rotate the tool, so that {model.joints[nearest]} has room at home"
    elif met:
        advice = f"{met.most_common(1)[0][0]} is beyond its limit most often: change base or workspace"
    return Finding("joint limits", f"{value}, {rooms[nearest]:.2f} rad", advice)


def collisions(env: ManipulationEnv, solved: Sequence[tuple[Pose, Any]]) -> Finding:
    """Check that links that are not neighbours stay apart, at the posture and over the workspaces."""
    robot, world = env.scene.robot, env.scene.world
    body = robot.body
    names = {-1: "the base", **{index: link.name for index, link in enumerate(body.links)}}
    parents = {index: link.parent for index, link in enumerate(body.links)}
    pairs = [
        (one, two)
        for one, two in itertools.combinations(names, 2)
        if not {one, parents.get(one)} & {parents[two], parents.get(parents[two])}
    ]
    worst, where = 0.0, ""
    for pose, joints in [(None, np.array(robot.model.posture)), *solved[::POINTS]]:
        robot.show_joints(joints.tolist())
        for one, two in pairs:
            points = world.closest_points(body, body, 0.0, one, two)
            depth = max((-point.distance for point in points), default=0)
            if depth > worst:
                place = "the posture" if pose is None else f"{np.round(pose.position, 2).tolist()} m"
                worst, where = depth, f" between {names[one]} and {names[two]} at {place}"
    env.scene.begin()
    advice = "check posture, and that the gripper points away from the arm (flange and tool)"
    bad = worst > MAX_COLLISION
    value = f"{1e3 * worst:.1f} mm{where if bad else ''}"
    return Finding("self-collision", value, advice if bad else "", bad)


def fingertips(env: ManipulationEnv) -> Finding:
    """Check that the fingers end at the tool frame."""
    robot, world = env.scene.robot, env.scene.world
    tips = min(world.bounds(robot.body, finger)[0][2] for finger in robot.finger_links)
    error = tips - robot.pose.z
    direction = "back to the arm" if error > 0.0 else "along the approach"
    advice = f"move the tool frame by {1e3 * abs(error):.0f} mm {direction}"
    bad = abs(error) > MAX_TIP_ERROR
    return Finding("fingertips", f"{1e3 * error:+.1f} mm above the tool frame", advice if bad else "", bad)


def fingers(env: ManipulationEnv) -> Finding:
    """Check the direction in which the fingers open, and the distances between them, closed and open."""
    robot, world = env.scene.robot, env.scene.world
    opened, direction = _between(robot, world)
    x, y, z = rotate(conjugate(robot.pose.orientation), direction)
    angle = math.atan2(math.hypot(y, z), abs(x))
    env.scene.begin()
    robot.set_opening(0.0)
    closed, _ = _between(robot, world)
    robot.set_opening(1.0)
    value = (
        f"open {1e3 * opened:.1f} mm, closed {1e3 * closed:.1f} mm, "
        f"{math.degrees(angle):.0f} degrees from the x axis of the tool frame"
    )
    errors = {
        "rotate the tool frame about z until its x axis is the opening direction": angle > MAX_ANGLE,
        "the fingers' joints must be at 0 where the fingers meet": closed > MAX_GAP,
        "correct gripper.stroke": abs(opened - robot.model.gripper.stroke) > MAX_GAP,
    }
    advice = next((text for text, wrong in errors.items() if wrong), "")
    return Finding("fingers", value, advice, bool(advice))


def _between(robot: Robot, world: World) -> tuple[float, Vector]:
    """Return the distance (m) between the fingers and the direction from one to the other."""
    points = world.closest_points(robot.body, robot.body, 1.0, *robot.finger_links)
    nearest = min(points, key=lambda point: point.distance)
    return max(nearest.distance, 0.0), nearest.normal


def static_torques(env: ManipulationEnv, solved: Sequence[tuple[Pose, Any]]) -> Finding:
    """Check the share of the torques that gravity takes over the workspaces, with a load."""
    robot = env.scene.robot
    still = np.zeros(len(robot.model.joints))
    shares = [
        np.abs(robot.dynamics.torques(joints, still, still, LOAD)) / robot.model.torques
        for _, joints in solved
    ]
    most = np.max(shares, axis=0) if shares else still
    number, bad = int(most.argmax()), bool(most.max() > MAX_STATIC)
    value = f"gravity and {LOAD} kg take {most[number]:.0%} of the torque of {robot.model.joints[number]}"
    return Finding("torques", value, "check force and the masses in the URDF" if bad else "", bad)


def tracking(model: RobotModel, workspace: Limits | None, mode: str, load: float) -> Finding:
    """Check the distance between commanded and reached tool positions in simulated moves; report speeds."""
    name = f"tracking, {mode}, " + (f"{load} kg" if load else "empty")
    with closing(_make(model, workspace, physics_mode=mode, fast_mode=False)) as env:
        scene, robot, home = env.scene, env.scene.robot, _home(workspace)
        (low, high), (left, right) = scene.config.workspace[2], scene.config.workspace[0]
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
            speed, acceleration = (
                max(speed, 2.0 * step / seconds),
                max(acceleration, 2.0 * step / (rise * seconds**2)),
            )
            robot.move_to(goal, in_contact=False)
            worst = max(worst, math.dist(robot.pose.position, goal.position))
    bad = worst > MAX_TRACKING
    advice = "increase force to the torques of the data sheet, or check the masses in the URDF"
    value = f"error of at most {1e3 * worst:.1f} mm; up to {speed:.2f} m/s, {acceleration:.0f} m/s^2"
    return Finding(name, value, advice if bad else "", bad)


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
    """Write an image of the arm at home with the axes of the tool frame, x red, y green, z blue."""
    with closing(_make(model, workspace)) as env:
        pose, camera = env.scene.robot.pose, Camera()
        image = Image.fromarray(camera.color(env.scene.world))
        lines = ImageDraw.Draw(image)
        for axis, colour in enumerate(("red", "green", "blue")):
            tip = pose.transform(tuple(0.1 * (axis == number) for number in range(3)))  # type: ignore[arg-type]
            lines.line([*camera.project(pose.position), *camera.project(tip)], fill=colour, width=3)
        image.save(path)


def main(argv: Sequence[str] | None = None) -> int:
    """Check an arm; return the exit status, 2 if something fails."""
    parser = argparse.ArgumentParser("python -m bulletarm_gym.check_robot", description=__doc__)
    parser.add_argument("robot", metavar="NAME", help="a built-in arm or module:attribute")
    parser.add_argument(
        "--workspace", type=float, nargs=6, metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"), help="limits (m)"
    )
    parser.add_argument("--image", type=Path, metavar="FILE", help="where to write an image of the arm")
    args = parser.parse_args(argv)
    if args.image is not None:
        _check_image(parser, args.image)
    workspace = None if args.workspace is None else np.reshape(args.workspace, (3, 2)).tolist()
    try:
        model = find_robot(args.robot)
        failed = report(check_robot(model, workspace))
        if args.image is not None:
            draw(model, workspace, args.image)
    except (ParameterError, ValueError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 2 if failed else 0


def _check_image(parser: argparse.ArgumentParser, path: Path) -> None:
    """End the program with a message if no image can be written to a path."""
    if path.suffix.lower() not in Image.registered_extensions():
        parser.error(f"--image must be a file name with the extension of an image, got {path}. Use .png.")
    if not path.absolute().parent.is_dir():
        parser.error(f"--image must be in an existing folder, got {path}")


if __name__ == "__main__":
    sys.exit(main())
