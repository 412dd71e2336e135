"""Arms reach all they should, move as told, and hold what they grasp."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from rollouts import step_on

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import (
    Pose,
    Quaternion,
    conjugate,
    euler_pose,
    multiply,
    wrap_angle,
    yaw_quaternion,
)
from bulletarm_gym.robots import ROBOTS, RobotModel
from bulletarm_gym.simulation.motion import interpolate_path

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
TILT = math.radians(30.0)


@pytest.fixture(params=ROBOTS.values(), ids=lambda model: model.name)
def model(request: pytest.FixtureRequest) -> RobotModel:
    return request.param


@pytest.fixture
def armed(make: Make, model: RobotModel) -> ManipulationEnv:
    """The picking task with each arm, at rest over a far cube."""
    env = make(PICKING, robot=model.name)
    env.reset(seed=0)
    env.scene["cube"].place(Pose((0.33, -0.12, 0.025)))
    return env


def test_models_are_written_in_lines_that_bullet_reads_whole(model: RobotModel) -> None:
    assert max(map(len, model.xml.splitlines())) < 1024


def angle_between(one: Quaternion, other: Quaternion) -> float:
    x, y, z, w = multiply(one, conjugate(other))
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def tilted(yaw: float, direction: float) -> Quaternion:
    """Upright, turned by ``yaw``, then tilted towards a direction."""
    axis = (-math.sin(direction), math.cos(direction))
    half = TILT / 2.0
    tilt = (axis[0] * math.sin(half), axis[1] * math.sin(half), 0.0, math.cos(half))
    return multiply(tilt, yaw_quaternion(yaw))


def test_inverse_depends_on_the_pose_alone(armed: ManipulationEnv) -> None:
    robot, goal = armed.scene.robot, Pose.planar(0.5, 0.1, 0.12, 0.4)
    robot.home(Pose.planar(0.45, 0.0, 0.2))
    from_home = robot.inverse_kinematics(goal)
    robot.home(Pose.planar(0.35, -0.1, 0.24, -1.0))
    from_afar = robot.inverse_kinematics(goal)
    assert from_afar[:-1] == from_home[:-1]
    assert wrap_angle(from_afar[-1] - from_home[-1]) == pytest.approx(0.0, abs=1e-9)


def test_out_of_reach_is_refused(armed: ManipulationEnv) -> None:
    before = armed.scene.robot.pose
    with pytest.raises(ValueError, match="reach"):
        armed.scene.robot.move_to(Pose.planar(1.6, 0.0, 0.2))
    assert armed.scene.robot.pose == before


def test_kinematics_agree_with_the_simulator(armed: ManipulationEnv) -> None:
    world, robot = armed.scene.world, armed.scene.robot
    indices = range(world.client.getNumJoints(robot.body.id))
    names = {world.client.getJointInfo(robot.body.id, index)[1].decode(): index for index in indices}
    for pose in (Pose.planar(0.45, 0.0, 0.2), Pose((0.5, -0.1, 0.15), tilted(0.7, 2.0))):
        robot.home(pose)
        link = world.client.getLinkState(
            robot.body.id, names[robot.model.joints[-1]], computeForwardKinematics=True
        )
        simulated = Pose(link[4], link[5]).compose(robot.model.tool)
        assert simulated.position == pytest.approx(pose.position, abs=1e-5)
        assert angle_between(simulated.orientation, pose.orientation) < 1e-4
        assert robot.pose.position == pytest.approx(pose.position, abs=1e-6)


@pytest.mark.parametrize("fast", [True, False])
def test_moves_arrive(make: Make, fast: bool) -> None:
    env = make(PICKING, fast_mode=fast)
    env.reset(seed=0)
    env.scene["cube"].place(Pose((0.33, -0.12, 0.025)))
    rng, robot = np.random.default_rng(0), env.scene.robot
    for _ in range(15):
        x, y, z, yaw = rng.uniform([0.42, -0.05, 0.1, -1.5], [0.58, 0.13, 0.25, 1.5]).tolist()
        env.scene.begin()
        robot.move_to(Pose.planar(x, y, z, yaw))
        assert math.dist(robot.pose.position, (x, y, z)) < 2e-3
        assert abs(wrap_angle(robot.pose.yaw - yaw)) < 0.01 and robot.pose.tilt < 0.01


@pytest.mark.parametrize("fast", [True, False])
def test_opening_follows_the_command(make: Make, model: RobotModel, fast: bool) -> None:
    env = make(PICKING, robot=model.name, fast_mode=fast)
    env.reset(seed=0)
    env.scene["cube"].place(Pose((0.33, -0.12, 0.025)))
    assert env.scene.robot.opening_ratio == pytest.approx(1.0, abs=0.02)
    for ratio in (0.0, 0.5, 0.2, 1.0):
        env.step([2.0 * ratio - 1.0, 0, 0, 0, 0])
        assert env.scene.robot.opening_ratio == pytest.approx(ratio, abs=0.03)


def test_joints_move_to_positions_and_are_measured(armed: ManipulationEnv) -> None:
    robot = armed.scene.robot
    goal = np.add(robot.joint_positions, 0.1)
    armed.scene.begin()
    robot.move_joints(goal)
    np.testing.assert_allclose(robot.joint_positions, goal, atol=2e-3)
    assert not any(robot.joint_velocities) and not robot.contacts
    assert 0.0 < np.abs(robot.joint_torques).max() < max(robot.model.torques)
    for wrong in (goal[:-1], goal + 10.0):
        with pytest.raises(ValueError, match="positions must be"):
            robot.move_joints(wrong)


def test_contacts_name_the_touched_body(armed: ManipulationEnv) -> None:
    grasp(armed)
    robot, cube = armed.scene.robot, armed.scene["cube"].body
    armed.scene.begin()
    robot.move_to(robot.pose.compose(Pose((0.0, 0.0, 0.01))))
    contacts = [contact for contact in robot.contacts if contact.other == cube]
    assert {contact.link for contact in contacts} == set(robot.finger_links)
    assert all(contact.force >= 0.0 and contact.distance < 0.01 for contact in contacts)


def test_the_wrist_camera_is_directed_at_the_fingertips(armed: ManipulationEnv) -> None:
    robot = armed.scene.robot
    centre = robot.camera_pose.transform((0.0, 0.0, robot.model.gripper.finger[2]))
    assert centre == pytest.approx(robot.pose.position)


def test_close_and_open(armed: ManipulationEnv) -> None:
    armed.scene.begin()
    armed.scene.robot.set_opening(0.0)
    assert armed.scene.robot.opening_ratio < 0.03 and armed.scene.robot.held is None
    armed.scene.robot.set_opening(1.0)
    assert armed.scene.robot.opening_ratio > 0.97


def grasp(env: ManipulationEnv, seed: int = 3) -> Pose:
    """Let the expert grasp the cube; return the cube's pose in the gripper."""
    env.reset(seed=seed)
    for _ in range(8):
        env.step(env.expert_action())
        if env.scene.held is not None and env.scene.robot.pose.z > 0.1:
            return in_hand(env)
    raise AssertionError("nothing grasped")


def in_hand(env: ManipulationEnv) -> Pose:
    return env.scene.robot.pose.inverse().compose(env.scene["cube"].pose)


def test_holds_a_cube_through_random_moves(make: Make, model: RobotModel) -> None:
    env = make(PICKING, robot=model.name)
    start, rng = grasp(env), np.random.default_rng(0)
    for _ in range(30):
        action = rng.uniform(-1, 1, 5)
        action[0] = -1.0
        action[3] = max(action[3], (0.1 - env.scene.robot.pose.z) / 0.05)  # stay off the floor
        observation, *_ = step_on(env, action)
        assert env.scene.held is not None and observation["holding"] == [1.0]
    end = in_hand(env)
    assert math.dist(start.position, end.position) < 5e-3
    assert angle_between(start.orientation, end.orientation) < 0.1


def test_lets_go_when_opened(make: Make, model: RobotModel) -> None:
    env = make(PICKING, robot=model.name)
    grasp(env)
    observation, *_ = env.step([1.0, 0, 0, 0, 0])
    assert env.scene.held is None and observation["holding"] == [0.0]
    assert env.scene["cube"].pose.z == pytest.approx(0.025, abs=2e-3)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_rotation_stops_at_the_joint_limits(armed: ManipulationEnv, direction: float) -> None:
    robot, (lower, upper) = armed.scene.robot, armed.scene.robot.model.chain.limits.T
    armed.step([1.0, 0.6, 0.4, -0.5, 0.0])
    start = robot.pose
    for _ in range(24):
        _, _, _, _, info = armed.step([1.0, 0.0, 0.0, 0.0, direction])
        joints = np.array(robot.joint_positions)
        assert not info["ignored"] and (lower <= joints).all() and (joints <= upper).all()
    assert math.dist(robot.pose.position, start.position) < 2e-3
    stopped = robot.pose.yaw
    armed.step([1.0, 0.0, 0.0, 0.0, -direction])
    assert wrap_angle(robot.pose.yaw - stopped) == pytest.approx(-direction * math.pi / 4.0, abs=0.02)


def test_the_expert_rotates_away_from_a_joint_limit(make: Make, model: RobotModel) -> None:
    env = make(PICKING, robot=model.name)
    for direction in (1.0, -1.0):
        env.reset(seed=0)
        for _ in range(10):
            env.step([1.0, 0.0, 0.0, 0.0, direction])
        for _ in range(20):
            *_, terminated, _, info = env.step(env.expert_action())
            if terminated:
                break
        assert info["is_success"]


def test_blocked_motion_stops(make: Make, model: RobotModel) -> None:
    """Closed fingers sent into the floor stay on it, and the arm is free to go up again."""
    armed = make(PICKING, robot=model.name, fast_mode=False)
    armed.reset(seed=0)
    armed.scene["cube"].place(Pose((0.33, -0.12, 0.025)))
    robot = armed.scene.robot
    robot.set_opening(0.0)
    for _ in range(2):
        armed.scene.begin()
        robot.move_to(Pose.planar(0.45, 0.0, -0.1))
        assert -0.03 < robot.pose.z < 0.02
    armed.scene.begin()
    robot.move_to(Pose.planar(0.45, 0.0, 0.1))
    assert robot.pose.z == pytest.approx(0.1, abs=2e-3)


def test_pressing_on_a_cube_does_not_drive_it_through_the_floor(armed: ManipulationEnv) -> None:
    armed.scene["cube"].place(Pose((0.45, 0.0, 0.025)))
    for _ in range(8):
        *_, info = armed.step([-1.0, 0.0, 0.0, -1.0, 0.0])
    assert info["is_valid"] and armed.scene["cube"].pose.z > 0.02
    armed.step([-1.0, 0.0, 0.0, 1.0, 0.0])
    assert armed.scene.robot.pose.z > 0.05


def test_gripper_stays_inside_the_workspace(picking: ManipulationEnv) -> None:
    for direction in itertools.product((-1.0, 1.0), repeat=3):
        picking.reset(seed=0)
        picking.scene["cube"].place(Pose((0.45, 0.0, 0.025)))
        for _ in range(6):
            picking.step([1.0, *direction, 0.0])
        hand = picking.scene.robot.pose.position
        for value, (low, high) in zip(hand, picking.config.workspace, strict=True):
            assert low - 3e-3 < value < high + 3e-3


def test_tilted_gripper_keeps_to_the_line(armed: ManipulationEnv) -> None:
    """Between neighbouring tilted poses joints may turn far; the fingertips must not swing meanwhile."""
    robot = armed.scene.robot
    for tilt, yaw in ((0.4, 1.5), (0.4, -1.5), (-0.4, 0.3)):
        end = euler_pose((0.45, 0.12, 0.047), (0.0, tilt, yaw))
        start = end.compose(Pose((0.0, 0.0, 0.1)))
        ends = [robot.inverse_kinematics(pose) for pose in (start, end)]
        stops = [ends[0], *robot._line(start, end), ends[1]]
        shares = np.linspace(0.0, 1.0, 21)
        for share, joints in zip(shares, interpolate_path(stops, shares), strict=True):
            straight = end.compose(Pose((0.0, 0.0, 0.1 * (1.0 - share)))).position
            assert math.dist(robot.model.chain.forward(joints).position, straight) < 4e-3
