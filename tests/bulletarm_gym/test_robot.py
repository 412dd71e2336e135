"""Built-in arms: inverse kinematics, motions, grasps and torques."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from rollouts import PICKING, TYPICAL, finish, step_on
from scipy.spatial.transform import Rotation

from bulletarm_gym.check.robot import TILT, grid
from bulletarm_gym.config import WORKSPACES
from bulletarm_gym.geometry import Pose, euler_pose, wrap_angle
from bulletarm_gym.robots import ROBOTS, OutOfReachError
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE
from bulletarm_gym.simulation.motion import interpolate_path

CORNER = Pose((0.33, -0.12, 0.025))
"""Pose of the cube out of the way of the gripper."""
SHARES = {"kuka": (0.91, 0.74), "panda": (1.0, 0.9), "ur5": (1.0, 1.0), "ur5_robotiq": (1.0, 1.0)}
"""Share of the open-loop workspace that is in reach, upright and tilted by 30 degrees."""


@pytest.fixture(params=ROBOTS.values(), ids=lambda model: model.name)
def model(request):
    return request.param


def at_rest(make, model, fast=True):
    env = make(PICKING, robot=model.name, fast_mode=fast, seed=0)
    env.scene["cube"].place(CORNER)
    return env


@pytest.fixture
def armed(make, model):
    return at_rest(make, model)


@pytest.fixture
def robot(armed):
    return armed.scene.robot


def far(first, second):
    """Return the distance (m) or the angle (rad) between two poses, whichever is larger."""
    start, end = (Rotation.from_quat(pose.orientation) for pose in (first, second))
    return max(math.dist(first.position, second.position), (start.inv() * end).magnitude())


def reached(model, heights, control, tilt=0.0):
    """Return the share of poses in reach; their solutions must be exact and inside the limits."""
    (lower, upper), found = model.chain.limits.T, []
    for pose in grid(WORKSPACES[control], heights, 5 if tilt else 7, tilt):
        joints, error = model.inverse(pose)
        found.append(error <= POSITION_TOLERANCE)
        if found[-1]:
            assert far(model.chain.forward(joints), pose) < 1e-3, pose
            assert (lower < joints).all() and (joints < upper).all(), pose
    return float(np.mean(found))


def test_inverse_kinematics_is_exact_within_the_limits(model):
    upright, tilted = SHARES[model.name]
    assert reached(model, (0.01, 0.07, 0.13, 0.19, 0.25), "close_loop") == 1.0
    assert reached(model, (0.02, 0.1, 0.25), "open_loop") >= upright
    assert reached(model, (0.02, 0.1, 0.2), "open_loop", TILT) >= tilted


def test_solutions_are_exact_from_rotated_postures(model):
    """A rotation error of half a turn is not mistaken for none."""
    poses = list(grid(WORKSPACES["close_loop"], (0.05, 0.2), 3))
    for joint, angle in itertools.product(range(len(model.joints)), (math.pi, math.pi / 2.0, -math.pi / 2.0)):
        start = np.array(model.posture)
        start[joint] += angle
        for pose in poses[::3]:
            joints, error = model.chain.inverse(pose, start)
            assert error > POSITION_TOLERANCE or far(model.chain.forward(joints), pose) < 1e-3


def test_joints_depend_on_the_pose_alone(robot):
    goal = Pose.planar(0.5, 0.1, 0.12, 0.4)
    first = robot.inverse_kinematics(goal)
    robot.home(Pose.planar(0.35, -0.1, 0.24, -1.0))
    turns = np.subtract(robot.inverse_kinematics(goal), first) / (2.0 * math.pi)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-6)
    with pytest.raises(OutOfReachError, match=robot.model.name):
        robot.move_to(Pose.planar(1.6, 0.0, 0.2))


@pytest.mark.parametrize("fast", [True, False])
def test_motions_arrive(make, model, fast):
    env = at_rest(make, model, fast)
    robot, tilted = env.scene.robot, euler_pose((0.5, 0.08, 0.2), (TILT, 0.2, 0.6))
    for goal in (Pose.planar(0.5, 0.08, 0.2, 0.6), tilted, Pose.planar(0.45, 0.0, 0.15)):
        env.scene.begin()
        robot.move_to(goal)
        assert far(robot.pose, goal) < 2e-3
    assert robot.opening_ratio == pytest.approx(1.0, abs=0.02)
    for ratio in (0.0, 0.5, 0.2, 1.0):
        env.scene.begin()
        robot.set_opening(ratio)
        assert robot.opening == pytest.approx(ratio * model.gripper.stroke, abs=2e-3)
        assert robot.opening_ratio == pytest.approx(ratio, abs=0.03) and robot.held is None


def test_motions_keep_to_the_straight_line(robot):
    """Near a joint limit of the wrist the elbow would swing by centimetres: such a motion is refused."""
    rng, tried = np.random.default_rng(0), 0
    for _ in range(100):
        position = rng.uniform((0.32, -0.13, 0.03), (0.58, 0.13, 0.23))
        start = Pose.planar(*position, rng.uniform(-math.pi, math.pi))
        shift, turn = rng.uniform(-0.03, 0.03, 3), rng.uniform(-0.7, 0.7)
        end = Pose.planar(*(position + shift), start.yaw + turn)
        if not robot.reaches(start):
            continue
        robot.home(start)
        if robot.can_move_to(end):
            leaves = robot.wrist_room(end) > robot.wrist_room()
            assert deviation(robot, start, end) < (0.03 if leaves else 0.012)
            tried += 1
    assert tried > 60
    for tilt, yaw in ((0.4, 1.5), (0.4, -1.5), (-0.4, 0.3)):
        end = euler_pose((0.45, 0.12, 0.047), (0.0, tilt, yaw))
        start = end.compose(Pose((0.0, 0.0, 0.1)))
        robot.home(start)
        assert deviation(robot, start, end) < 4e-3


def deviation(robot, start, end):
    """Return the maximum distance (m) of a motion from the line between two poses."""
    stops = [robot.joint_positions, *robot._line(start, end), robot.inverse_kinematics(end)]
    path = interpolate_path(stops, np.linspace(0.0, 1.0, 41))
    points = np.array([robot.model.chain.forward(joints).position for joints in path]) - start.position
    way = np.subtract(end.position, start.position)
    shares = np.clip(points @ way / (way @ way), 0.0, 1.0)
    return np.linalg.norm(points - shares[:, None] * way, axis=1).max()


def test_joints_move_to_positions_and_are_measured(armed, robot):
    goal = np.add(robot.joint_positions, 0.1)
    armed.scene.begin()
    robot.move_joints(goal)
    np.testing.assert_allclose(robot.joint_positions, goal, atol=2e-3)
    assert not any(robot.joint_velocities)
    assert 0.0 < np.abs(robot.joint_torques).max() < max(robot.model.torques)
    centre = robot.camera_pose.transform((0.0, 0.0, robot.model.gripper.finger[2]))
    assert centre == pytest.approx(robot.pose.position)
    for wrong in (goal[:-1], goal + 10.0):
        with pytest.raises(ValueError, match="positions"):
            robot.move_joints(wrong)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_rotation_stops_at_the_joint_limits_and_the_expert_goes_on(armed, robot, direction):
    lower, upper = robot.model.chain.limits.T
    armed.step([1.0, 0.6, 0.4, -0.5, 0.0])
    start = robot.pose
    for _ in range(24):
        *_, info = armed.step([1.0, 0.0, 0.0, 0.0, direction])
        joints = np.array(robot.joint_positions)
        assert not info["ignored"] and (lower <= joints).all() and (joints <= upper).all()
    assert math.dist(robot.pose.position, start.position) < 2e-3
    stopped = robot.pose.yaw
    armed.step([1.0, 0.0, 0.0, 0.0, -direction])
    assert wrap_angle(robot.pose.yaw - stopped) == pytest.approx(-direction * math.pi / 4.0, abs=0.02)
    solved, steps = finish(armed)
    assert solved and steps <= 20


@pytest.mark.parametrize("task", ["BlockPicking", "BlockPulling"])
def test_expert_solves_tasks_with_each_arm(make, model, task):
    env = make(f"BulletArm/CloseLoop{task}-v0", robot=model.name)
    for seed in range(2):
        env.reset(seed=seed)
        solved, steps = finish(env)
        assert solved and steps <= 12


@pytest.mark.parametrize("env_id", [env_id for env_id in TYPICAL if "Grasping" not in env_id])
def test_initial_poses_do_not_depend_on_the_arm(make, env_id):
    envs, starts = [make(env_id, robot=name, obs_size=16) for name in ("kuka", "panda", "ur5")], set()
    for env in envs:
        env.reset(seed=0)
        starts.add(tuple(item.pose for item in env.scene))
    assert len(starts) == 1


def grasp(env, seed=3):
    """Let the expert grasp the cube; return the cube's pose in the gripper."""
    env.reset(seed=seed)
    while env.scene.held is None or env.scene.robot.pose.z <= 0.1:
        env.step(env.expert_action())
    return in_hand(env)


def in_hand(env):
    return env.scene.robot.pose.inverse().compose(env.scene["cube"].pose)


def test_gripper_holds_a_cube_until_it_opens(make, model):
    env = make(PICKING, robot=model.name)
    start, rng, robot = grasp(env), np.random.default_rng(0), env.scene.robot
    cube = env.scene["cube"].body
    assert robot.opening == pytest.approx(cube.spec.extents[0], abs=3e-3)
    for _ in range(30):
        action = rng.uniform(-1, 1, 5)
        action[0] = -1.0
        action[3] = max(action[3], (0.1 - robot.pose.z) / 0.05)  # stay above the floor
        observation, *_ = step_on(env, action)
        assert robot.held is cube and observation["holding"] == [1.0]
    end = in_hand(env)
    assert math.dist(start.position, end.position) < 5e-3 and far(start, end) < 0.1
    env.scene.begin()
    robot.move_to(euler_pose((0.45, 0.0, 0.15), (TILT, 0.0, robot.pose.yaw)))
    assert robot.held is cube
    contacts = [contact for contact in env.scene.world.contacts(robot.body) if contact.other == cube]
    assert {contact.link for contact in contacts} == set(robot.finger_links)
    observation, *_ = step_on(env, [1.0, 0, 0, 0, 0])
    assert robot.held is None and observation["holding"] == [0.0]
    assert env.scene["cube"].pose.z == pytest.approx(0.025, abs=2e-3)


def test_torques_agree_with_the_simulator(armed, robot):
    """Bullet's inverse dynamics counts the fingers where they are, ours at the tool."""
    world, joints = armed.scene.world, list(robot._arm.joints)
    rng, count = np.random.default_rng(0), len(robot.body.joints)
    for _ in range(10):
        positions, rates, accelerations = np.array(world.joints[robot.body.index]), *np.zeros((2, count))
        positions[joints] += rng.uniform(-0.3, 0.3, len(joints))
        rates[joints], accelerations[joints] = rng.uniform((-1.0, -5.0), (1.0, 5.0), (len(joints), 2)).T
        motion = (positions, rates, accelerations)
        expected = world.client.calculateInverseDynamics(robot.body.id, *(part.tolist() for part in motion))
        torques = robot.dynamics.torques(*(part[joints] for part in motion))
        assert torques == pytest.approx(np.array(expected)[joints], abs=0.1)


PAGE = Path(__file__).parents[2] / "docs" / "guides" / "robot.md"


def test_the_page_names_members_of_the_robot(make):
    robot = make(PICKING).scene.robot
    table = PAGE.read_text(encoding="utf-8").partition("| member of `scene.robot` |")[2].partition("\n\n")[0]
    names = [name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)", row.split("|")[1])]
    assert len(names) > 5 and [name for name in names if not hasattr(robot, name)] == []
