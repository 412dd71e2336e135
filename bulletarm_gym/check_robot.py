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
from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WORKSPACES, ParameterError
from bulletarm_gym.control.control import MIN_REACH
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, conjugate, multiply
from bulletarm_gym.robots import RobotModel, find_robot
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.selfcheck import Finding, report
from bulletarm_gym.simulation import Camera
from bulletarm_gym.simulation.motion import RISE
from bulletarm_gym.simulation.world import TIME_STEP

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
POINTS = 7
"""Number of positions along each side of a workspace."""
HEIGHTS = {CLOSE_LOOP: (0.01, 0.13, 0.25), OPEN_LOOP: (0.02, 0.1, 0.25)}
"""Heights (m) of the fingertips."""
LOAD = 0.2
"""Mass (kg) of the object in the checks of torques and tracking."""
MAX_ERROR = 1e-3
"""Maximum error (m or rad) of inverse kinematics."""
MAX_COLLISION = 5e-3
"""Maximum overlap (m) of links that are not neighbours."""
MAX_TIP_ERROR = 5e-3
"""Maximum distance (m) between the tool frame and the lowest point of the fingers."""
MAX_TRACKING = 5e-3
"""Maximum distance (m) between a commanded and a reached tool position."""
MAX_STATIC = 0.8
"""Maximum share of a joint's torque that gravity may take."""
MAX_GAP = 5e-3
"""Maximum distance (m) between closed fingers."""
STEP = 0.05
"""Length (m) of the closed-loop step whose speed is reported."""


def check_robot(model: RobotModel) -> Iterator[Finding]:
    """Yield the findings on an arm; the last one says why no environment can be made with it, if so."""
    yield from (reach(model, control) for control in (CLOSE_LOOP, OPEN_LOOP))
    yield accuracy(model)
    yield limits(model)
    try:
        env = _make(model)
    except ParameterError as error:
        yield Finding("environment", " ".join(str(error).split()), "see the lines above", fails=True)
        return
    with closing(env):
        yield from (check(env) for check in (collisions, fingertips, static_torques, pace, gap))
    for mode, load in itertools.product(("fast", "slow"), (0.0, LOAD)):
        yield tracking(model, mode, load)


def _make(model: RobotModel, **parameters: Any) -> ManipulationEnv:
    env: ManipulationEnv = gymnasium.make(PICKING, robot=model, **parameters).unwrapped  # type: ignore[assignment]
    env.reset(seed=0)
    return env


def _grid(control: str) -> list[Pose]:
    xs, ys = (np.linspace(low, high, POINTS).tolist() for low, high in WORKSPACES[control][:2])
    return [Pose.planar(x, y, z) for x, y, z in itertools.product(xs, ys, HEIGHTS[control])]


def _solutions(model: RobotModel) -> list[tuple[Pose, Any]]:
    """Return the poses of both default workspaces that are in reach, with their joint positions (rad)."""
    solved = [(pose, model.inverse(pose)) for pose in (*_grid(CLOSE_LOOP), *_grid(OPEN_LOOP))]
    return [(pose, joints) for pose, (joints, error) in solved if error <= POSITION_TOLERANCE]


def reach(model: RobotModel, control: str) -> Finding:
    """Check the share of a default workspace that is in reach, and find the largest one that would be."""
    reached = {pose: model.inverse(pose)[1] <= POSITION_TOLERANCE for pose in _grid(control)}
    share = sum(reached.values()) / len(reached)
    (x0, x1), (y0, y1), _ = WORKSPACES[control]
    middle, side = ((x0 + x1) / 2.0, (y0 + y1) / 2.0), x1 - x0
    inside = (
        size
        for size in np.linspace(side, 0.0, POINTS).tolist()
        if all(
            good
            for pose, good in reached.items()
            if max(abs(pose.x - middle[0]), abs(pose.y - middle[1])) <= size / 2.0 + 1e-9
        )
    )
    largest = next(inside, 0.0)
    value = f"{share:.0%} of the default workspace in reach; around its middle a square of {largest:.2f} m"
    advice = "change base or posture (tools/reach.py compares bases), or pass a smaller workspace"
    return Finding(f"reach, {control}", value, "" if share >= MIN_REACH else advice, share < MIN_REACH)


def accuracy(model: RobotModel) -> Finding:
    """Check that forward kinematics returns the poses that inverse kinematics was solved for."""
    worst = 0.0
    for pose, joints in _solutions(model):
        found = model.chain.forward(joints)
        x, y, z, w = multiply(conjugate(found.orientation), pose.orientation)
        angle = 2.0 * math.atan2(math.hypot(x, y, z), abs(w))
        worst = max(worst, math.dist(found.position, pose.position), angle)
    advice = "check the axes and frames of the joints in the URDF"
    bad = worst > MAX_ERROR
    return Finding("inverse kinematics", f"error of at most {worst:.1e} m or rad", advice if bad else "", bad)


def limits(model: RobotModel) -> Finding:
    """Report the room that the joints have at the middle of the closed-loop workspace."""
    joints, error = model.inverse(Pose.planar(0.45, 0.0, 0.2))
    lower, upper = model.chain.limits.T
    rooms = np.minimum(joints - lower, upper - joints)
    number = int(rooms.argmin())
    value = f"{rooms[number]:.2f} rad from a limit at home, the nearest is {model.joints[number]}"
    advice = "choose a posture or mount the tool so that the joints are far from their limits at home"
    return Finding("joint limits", value, advice if rooms[number] < 0.2 or error > POSITION_TOLERANCE else "")


def collisions(env: ManipulationEnv) -> Finding:
    """Check that links that are not neighbours stay apart, at the posture and over both workspaces."""
    robot, world = env.scene.robot, env.scene.world
    client, body = world.client, robot.body
    count = client.getNumJoints(body.id)
    parents = {link: client.getJointInfo(body.id, link)[16] for link in range(count)}
    pairs = [
        (one, two)
        for one, two in itertools.combinations(range(-1, count), 2)
        if not {one, parents.get(one)} & {parents[two], parents.get(parents[two])}
    ]
    worst, where = 0.0, ""
    samples = [(None, np.array(robot.model.posture)), *_solutions(robot.model)[::POINTS]]
    for pose, joints in samples:
        world.show_joints(body, robot._arm.moved(world, joints.tolist()))
        for one, two in pairs:
            points = client.getClosestPoints(body.id, body.id, 0.0, one, two)
            depth = max((-point[8] for point in points), default=0.0)
            if depth > worst:
                worst, where = depth, f" between links {one} and {two} at {pose or 'the posture'}"
    env.scene.begin()
    advice = "check posture, and that the gripper points away from the arm (flange and tool)"
    bad = worst > MAX_COLLISION
    return Finding(
        "self-collision", f"{1e3 * worst:.1f} mm{where if bad else ''}", advice if bad else "", bad
    )


def fingertips(env: ManipulationEnv) -> Finding:
    """Check that the fingers end at the tool frame."""
    robot, client = env.scene.robot, env.scene.world.client
    tips = min(client.getAABB(robot.body.id, finger)[0][2] for finger in robot._fingers.joints)
    error = tips - robot.pose.z
    direction = "back to the arm" if error > 0.0 else "along the approach"
    advice = f"move the tool frame by {1e3 * abs(error):.0f} mm {direction}"
    bad = abs(error) > MAX_TIP_ERROR
    return Finding("fingertips", f"{1e3 * error:+.1f} mm above the tool frame", advice if bad else "", bad)


def static_torques(env: ManipulationEnv) -> Finding:
    """Check the share of the torques that gravity takes over both workspaces, with a load."""
    robot = env.scene.robot
    still = np.zeros(len(robot.model.joints))
    shares = [
        np.abs(robot._dynamics.torques(joints, still, still, LOAD)) / robot.model.torques
        for _, joints in _solutions(robot.model)
    ]
    most = np.max(shares, axis=0) if shares else still
    number, bad = int(most.argmax()), bool(most.max() > MAX_STATIC)
    value = f"gravity and {LOAD} kg take {most[number]:.0%} of the torque of {robot.model.joints[number]}"
    return Finding("torques", value, "check force and the masses in the URDF" if bad else "", bad)


def pace(env: ManipulationEnv) -> Finding:
    """Report the peak speed and acceleration of a closed-loop step that is limited by torques alone."""
    robot = env.scene.robot
    start = robot.pose
    end = Pose((start.x, start.y, start.z - STEP), start.orientation)
    path = np.array([robot.inverse_kinematics(start), robot.inverse_kinematics(end)])
    values = []
    for name, load in (("empty", 0.0), (f"with {LOAD} kg", LOAD)):
        seconds = robot._dynamics.least_steps(path, np.array(robot.model.torques), load) * TIME_STEP
        speed, acceleration = 2.0 * STEP / seconds, 2.0 * STEP / (RISE * seconds**2)
        values.append(f"{name} {speed:.1f} m/s and {acceleration:.0f} m/s^2")
    return Finding("pace", f"the torques allow a step of {STEP} m at " + ", ".join(values))


def gap(env: ManipulationEnv) -> Finding:
    """Check that the fingers meet."""
    robot = env.scene.robot
    env.scene.begin()
    robot.set_opening(0.0)
    opening = robot.opening
    robot.set_opening(1.0)
    advice = "the fingers' joints must be at 0 where the fingers meet"
    bad = opening > MAX_GAP
    return Finding("closed fingers", f"{1e3 * opening:.1f} mm apart", advice if bad else "", bad)


def tracking(model: RobotModel, mode: str, load: float) -> Finding:
    """Check the distance between commanded and reached tool positions in simulated moves."""
    name = f"tracking, {mode}, " + (f"{load} kg" if load else "empty")
    with closing(_make(model, physics_mode=mode, fast_mode=False, max_steps=100)) as env:
        robot, worst = env.scene.robot, 0.0
        if load:
            env.scene["cube"].set_properties(mass=load)
            for _ in range(20):
                if robot.held is not None:
                    break
                env.step(env.expert_action())
            if robot.held is None:
                return Finding(name, "the expert grasps no cube", "see the lines above", fails=True)
        for x, y in ((0.45, 0.0), (0.5, 0.08), (0.4, -0.08)):
            pose = Pose.planar(x, y, 0.2)
            env.scene.begin()
            robot.move_to(pose)
            worst = max(worst, math.dist(robot.pose.position, pose.position))
    bad = worst > MAX_TRACKING
    advice = "increase force to the torques of the data sheet, or check the masses in the URDF"
    return Finding(name, f"error of at most {1e3 * worst:.1f} mm", advice if bad else "", bad)


def draw(model: RobotModel, path: Path) -> None:
    """Write an image of the arm at home with the axes of the tool frame, x red, y green, z blue."""
    with closing(_make(model)) as env:
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
    parser.add_argument("--image", type=Path, metavar="FILE", help="where to write an image of the arm")
    args = parser.parse_args(argv)
    try:
        model = find_robot(args.robot)
        failed = report(check_robot(model))
        if args.image is not None:
            draw(model, args.image)
    except (ParameterError, ValueError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 2 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
