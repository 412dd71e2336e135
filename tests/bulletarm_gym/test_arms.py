"""What every arm must do: reach, move smoothly, stand sanely, grip, hold, solve the tasks, repeat exactly."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from rollouts import make_env, transcript

import bulletarm_gym
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import (
    FloatArray,
    Pose,
    Quaternion,
    euler_pose,
    matrix,
    multiply,
    wrap_angle,
    yaw_quaternion,
)
from bulletarm_gym.robots import KUKA, PANDA, ROBOTS, Robot, RobotModel, read_urdf
from bulletarm_gym.robots.editing import merge_fixed
from bulletarm_gym.robots.kinematics import POSITION_TOLERANCE, Chain
from bulletarm_gym.robots.primitives import box, cylinder
from bulletarm_gym.simulation.motion import interpolate_path

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
TASKS = ("BlockReaching", "BlockPicking", "BlockPulling")
TILT = math.radians(30.0)
"""The largest tilt (rad) that the workspaces of the paper's 6D tasks ask for, in any direction."""
XY = tuple(itertools.product(np.linspace(0.25, 0.65, 9).tolist(), np.linspace(-0.2, 0.2, 9).tolist()))
CLOSED = tuple(itertools.product(np.linspace(0.3, 0.6, 5).tolist(), np.linspace(-0.15, 0.15, 5).tolist()))
YAWS = tuple(np.linspace(-math.pi / 2.0, math.pi / 2.0, 5).tolist())
DIRECTIONS = tuple(np.linspace(-math.pi, math.pi, 8, endpoint=False).tolist())
SHARES = {"kuka": (0.91, 0.77), "panda": (1.0, 0.9), "ur5": (1.0, 1.0), "ur5_robotiq": (1.0, 1.0)}
"""Share of the open-loop workspace that is in reach, upright and tilted by 30 degrees."""
MIDDLE = Pose.planar(0.45, 0.0, 0.15)
PLAIN_IDS = [env_id for env_id in bulletarm_gym.ENV_IDS if "Grasping" not in env_id]
"""Ids whose starts are cheap to arrange."""

Make = Callable[..., ManipulationEnv]


@pytest.fixture(params=ROBOTS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def model(name: str) -> RobotModel:
    return ROBOTS[name]


@pytest.fixture
def arm_env(make: Make, name: str) -> ManipulationEnv:
    env = make(PICKING, robot=name)
    env.reset(seed=0)
    return env


@pytest.fixture
def robot(arm_env: ManipulationEnv) -> Robot:
    return arm_env.scene.robot


def tilted(yaw: float, tilt: float, direction: float) -> Quaternion:
    sine = math.sin(tilt / 2.0)
    about = (sine * math.cos(direction), sine * math.sin(direction), 0.0, math.cos(tilt / 2.0))
    return multiply(about, yaw_quaternion(yaw))


def upright_poses(points: Sequence[tuple[float, float]], heights: Sequence[float]) -> list[Pose]:
    return [Pose.planar(x, y, z, yaw) for (x, y), z, yaw in itertools.product(points, heights, YAWS)]


def tilted_poses() -> list[Pose]:
    grid = itertools.product(XY, (0.02, 0.1, 0.2), DIRECTIONS, YAWS[1:4:2])
    return [Pose((x, y, z), tilted(yaw, TILT, direction)) for (x, y), z, direction, yaw in grid]


def far(first: Pose, second: Pose) -> float:
    """Distance (m) or angle (rad) between two poses, whichever is larger."""
    w = abs(multiply(first.inverse().orientation, second.orientation)[3])
    return max(math.dist(first.position, second.position), 2.0 * math.acos(min(1.0, w)))


def finger_bounds(env: ManipulationEnv, finger: int) -> np.ndarray:
    """Lowest and highest corner (2, 3) of a finger in the simulator, which adds a margin of its own."""
    client, body = env.scene.world.client, env.scene.robot.body.id
    names = [client.getJointInfo(body, joint)[1].decode() for joint in range(client.getNumJoints(body))]
    joint = names.index(env.scene.robot.model.gripper.joints[finger])
    return np.array(client.getAABB(body, joint))


def test_parameter_offers_every_arm() -> None:
    assert list(ROBOTS) == ["kuka", "panda", "ur5", "ur5_robotiq"]
    with pytest.raises(
        ValueError, match=r"robot must be one of 'kuka', 'panda', 'ur5', 'ur5_robotiq'.*, got 'ur10'"
    ):
        make_env(PICKING, robot="ur10")


# Kinematics


def reached(model: RobotModel, poses: Sequence[Pose]) -> float:
    """Return the share of poses in reach; their solutions must be exact and inside the limits."""
    lower, upper = model.chain.limits.T
    count = 0
    for pose in poses:
        joints, error = model.inverse(pose)
        if error <= POSITION_TOLERANCE:
            count += 1
            assert far(model.chain.forward(joints), pose) < 1e-3, pose
            assert (lower < joints).all() and (joints < upper).all(), pose
    return count / len(poses)


def test_reaches_the_closed_loop_workspace(model: RobotModel) -> None:
    assert reached(model, upright_poses(CLOSED, (0.01, 0.07, 0.13, 0.19, 0.25))) == 1.0


def test_reaches_a_known_share_of_the_open_loop_workspace(model: RobotModel) -> None:
    upright, slanted = SHARES[model.name]
    assert reached(model, upright_poses(XY, (0.02, 0.1, 0.25))) >= upright
    assert reached(model, tilted_poses()) >= slanted


def test_solutions_are_exact_from_rotated_postures(model: RobotModel) -> None:
    """A rotation error of half a turn is not mistaken for none."""
    poses = [pose for pose in upright_poses(CLOSED, (0.05, 0.2)) if pose.yaw > -2.0]
    for joint, angle in itertools.product(range(len(model.joints)), (math.pi, math.pi / 2.0, -math.pi / 2.0)):
        start = np.array(model.posture)
        start[joint] += angle
        for pose in poses[::3]:
            joints, error = model.chain.inverse(pose, start)
            assert error > POSITION_TOLERANCE or far(model.chain.forward(joints), pose) < 1e-3


def test_random_chains_solve_their_own_poses() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        count = int(rng.integers(5, 8))
        frames = [euler_pose(rng.uniform(-0.2, 0.2, 3), rng.uniform(-3.0, 3.0, 3)) for _ in range(count + 1)]
        axes = rng.normal(size=(count, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        limits = np.stack([rng.uniform(-3.0, -1.0, count), rng.uniform(1.0, 3.0, count)], axis=1)
        rotations = np.stack([matrix(frame) for frame in frames])
        chain = Chain(rotations, np.array([frame.position for frame in frames]), axes, limits)
        for _ in range(10):
            pose = chain.forward(rng.uniform(-0.9, 0.9, count))
            for start in (np.zeros(count), np.full(count, math.pi), rng.uniform(-0.9, 0.9, count)):
                joints, error = chain.inverse(pose, start)
                if error <= POSITION_TOLERANCE:
                    assert far(chain.forward(joints), pose) < 1e-3
                    assert (limits[:, 0] <= joints).all() and (joints <= limits[:, 1]).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"posture": (0.0, 0.6, 0.0)}, ("posture", "7", "3")),
        ({"posture": (0.0, 0.6, 0.0, -2.5, 0.0, 0.7, 0.0)}, ("posture", "-2.5", "lbr_iiwa_joint_4")),
        ({"force": (300.0, 300.0)}, ("force", "7", "2")),
    ],
)
def test_a_model_with_wrong_joint_values_is_refused(changes: dict[str, Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError) as error:
        make_env(PICKING, robot=replace(KUKA, **changes))
    assert all(word in str(error.value) for word in words)


def test_refuses_what_is_out_of_reach(robot: Robot, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name!r} cannot reach"):
        robot.inverse_kinematics(Pose.planar(1.5, 0.0, 0.2))


def test_joints_follow_from_the_pose_alone(robot: Robot) -> None:
    goal = Pose.planar(0.5, 0.1, 0.1, 0.7)
    first = robot.inverse_kinematics(goal)
    robot.home(Pose.planar(0.3, -0.15, 0.2, -2.5))
    second = robot.inverse_kinematics(goal)
    assert [wrap_angle(a - b) for a, b in zip(first, second, strict=True)] == pytest.approx(
        [0.0] * len(first)
    )


def test_neighbouring_poses_have_neighbouring_joints(model: RobotModel) -> None:
    """A straight line in the joints is nearly one at the fingertips, over the largest close-loop moves."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        start = rng.uniform((0.3, -0.15, 0.02, -0.8), (0.6, 0.15, 0.25, 0.8))
        move = rng.uniform(-1.0, 1.0, 4) * (0.05, 0.05, 0.05, math.pi / 4.0)
        end = np.append((start + move)[:3].clip((0.3, -0.15, 0.02), (0.6, 0.15, 0.25)), start[3] + move[3])
        first, last = (model.inverse(Pose.planar(*pose.tolist()))[0] for pose in (start, end))
        change = np.array([wrap_angle(turn) for turn in (last - first).tolist()])
        assert np.abs(change).max() < 1.0
        assert np.abs(change[:-1]).max() < 0.5
        for share in (0.25, 0.5, 0.75):
            position = model.chain.forward(first + share * change).position
            assert math.dist(position, start[:3] + share * (end - start)[:3]) < 0.006


@pytest.mark.parametrize("height", [0.02, 0.25])
def test_no_link_is_below_the_ground(arm_env: ManipulationEnv, robot: Robot, height: float) -> None:
    client = arm_env.scene.world.client
    links = range(client.getNumJoints(robot.body.id))
    for x, y in CLOSED:
        robot.home(Pose.planar(x, y, height, 0.8))
        lowest = [client.getAABB(robot.body.id, link)[0][2] for link in links]
        assert min(lowest) > -0.01
        assert client.getLinkState(robot.body.id, 2)[4][2] > height + 0.1, "the elbow is down"


# Frames and gripper


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2.0])
def test_fingers_open_along_x_and_end_at_the_pose(arm_env: ManipulationEnv, robot: Robot, yaw: float) -> None:
    """As the simulator has them: mirrored about the pose, the stroke apart, their tips at its height."""
    robot.home(Pose.planar(*MIDDLE.position, yaw))
    axis = 0 if yaw == 0.0 else 1
    bounds = [finger_bounds(arm_env, finger) - MIDDLE.position for finger in range(2)]
    lower, upper = sorted(bounds, key=lambda corners: float(corners[0, axis]))
    gap = robot.model.gripper.stroke / 2.0
    assert upper[0, axis] == pytest.approx(gap, abs=2e-3)
    assert lower[1, axis] == pytest.approx(-gap, abs=2e-3)
    thickness, width, _ = robot.model.gripper.finger
    for corners in (lower, upper):
        low, high = corners
        assert low[2] == pytest.approx(0.0, abs=3e-3)
        assert low[1 - axis] == pytest.approx(-high[1 - axis], abs=1e-3)
        assert high[1 - axis] > width / 2.0 - 1e-3
        assert high[axis] - low[axis] > thickness - 1e-3


@pytest.mark.parametrize("fast", [True, False])
def test_opens_and_closes_over_its_stroke(make: Make, name: str, fast: bool) -> None:
    env = make(PICKING, robot=name, fast_mode=fast)
    env.reset(seed=0)
    robot = env.scene.robot
    assert robot.opening_ratio == pytest.approx(1.0)
    for ratio in (0.0, 0.5, 1.0):
        env.scene.begin()
        robot.set_opening(ratio)
        assert robot.opening_ratio == pytest.approx(ratio, abs=0.02)
        assert robot.opening == pytest.approx(ratio * robot.model.gripper.stroke, abs=2e-3)
        assert robot.held is None


@pytest.mark.parametrize("fast", [True, False])
def test_moves_arrive(make: Make, name: str, fast: bool) -> None:
    env = make(PICKING, robot=name, fast_mode=fast)
    env.reset(seed=0)
    goals = (Pose.planar(0.5, 0.08, 0.2, 0.6), Pose((0.5, 0.08, 0.2), tilted(0.6, TILT, 2.0)), MIDDLE)
    for goal in goals:
        env.scene.begin()
        env.scene.robot.move_to(goal)
        assert far(env.scene.robot.pose, goal) < 2e-3


def test_closes_on_and_holds_a_cube(arm_env: ManipulationEnv, robot: Robot) -> None:
    """Over 40 random moves of the largest size, and tilted, the cube stays in the gripper where it was."""
    grasp_with_the_expert(arm_env)
    cube = arm_env.scene["cube"]
    assert robot.opening == pytest.approx(cube.spec.extents[0], abs=3e-3)
    rng = np.random.default_rng(0)
    move(arm_env, MIDDLE)
    before = robot.pose.inverse().compose(cube.pose)
    for _ in range(40):
        hand = robot.pose
        step = rng.uniform(-0.05, 0.05, 3)
        x, y, z = (hand.position + step).clip((0.3, -0.15, 0.06), (0.6, 0.15, 0.25)).tolist()
        yaw = hand.yaw + rng.uniform(-1.0, 1.0) * math.pi / 4.0
        move(arm_env, Pose.planar(x, y, z, min(max(yaw, -1.5), 1.5)))
        assert robot.held is cube.body
    after = robot.pose.inverse().compose(cube.pose)
    assert math.dist(before.position, after.position) < 5e-3
    move(arm_env, Pose((0.45, 0.0, 0.15), tilted(robot.pose.yaw, TILT, 1.0)))
    assert robot.held is cube.body
    arm_env.scene.begin()
    robot.set_opening(1.0)
    assert robot.held is None


def grasp_with_the_expert(env: ManipulationEnv) -> None:
    for _ in range(10):
        env.step(env.expert_action())
        if env.scene.robot.held is not None:
            return
    pytest.fail("the expert did not grasp")


def move(env: ManipulationEnv, pose: Pose) -> None:
    env.scene.begin()
    env.scene.robot.move_to(pose)
    env.scene.settle()


# Tasks


@pytest.mark.parametrize("task", TASKS)
def test_solves_the_tasks(make: Make, name: str, task: str) -> None:
    env = make(f"BulletArm/CloseLoop{task}-v0", robot=name)
    for seed in range(5):
        env.reset(seed=seed)
        done, steps = False, 0
        while not done:
            _, reward, terminated, truncated, _ = env.step(env.expert_action())
            done, steps = terminated or truncated, steps + 1
        assert reward == 1.0, f"seed {seed}"
        assert steps <= 12, f"seed {seed}"


@pytest.fixture(scope="session")
def elsewhere(in_another_process: Callable[[dict[str, Any]], dict[str, list[str]]]) -> dict[str, list[str]]:
    """What each arm does in another process."""
    return in_another_process({name: (PICKING, {"robot": name}, None) for name in ROBOTS})


def test_repeats_exactly(make: Make, name: str, elsewhere: dict[str, list[str]]) -> None:
    env = make(PICKING, robot=name)
    first = transcript(env, seed=0)
    transcript(env, 30, seed=99, action_seed=5)
    assert transcript(env, seed=0) == first, "after other episodes"
    assert elsewhere[name] == first, "in another process"


# Models


def test_merging_fixed_links_keeps_masses_and_places() -> None:
    root = ElementTree.fromstring(
        """<robot name="two">
        <link name="a"><inertial><mass value="1"/></inertial></link>
        <link name="b">
          <inertial><origin xyz="0 0 1"/><mass value="3"/></inertial>
          <visual><origin xyz="0 0 1"/><geometry><sphere radius="1"/></geometry></visual>
        </link>
        <link name="c"/>
        <joint name="ab" type="fixed">
          <parent link="a"/><child link="b"/><origin xyz="1 0 0" rpy="0 0 1.5"/>
        </joint>
        <joint name="bc" type="revolute"><parent link="b"/><child link="c"/><origin xyz="1 0 0"/></joint>
        </robot>"""
    )
    merge_fixed(root)
    assert [link.get("name") for link in root.findall("link")] == ["a", "c"]
    assert numbers(root, "link/inertial/mass", "value") == pytest.approx([4.0])
    assert numbers(root, "link/inertial/origin", "xyz") == pytest.approx([0.75, 0.0, 0.75])
    assert numbers(root, "link/visual/origin", "xyz") == pytest.approx([1.0, 0.0, 1.0])
    assert numbers(root, "joint/origin", "xyz") == pytest.approx([1.0 + math.cos(1.5), math.sin(1.5), 0.0])
    assert numbers(root, "joint/origin", "rpy") == pytest.approx([0.0, 0.0, 1.5])
    assert root.findall("joint/parent")[0].get("link") == "a"


def numbers(root: ElementTree.Element, path: str, key: str) -> list[float]:
    return [float(text) for text in root.findall(path)[0].get(key, "").split()]


def test_parts_that_are_only_seen_do_not_collide() -> None:
    for is_solid, tags in ((False, ["visual"] * 2), (True, ["visual", "collision"] * 2)):
        link = ElementTree.Element("link")
        cylinder(0.1, 0.2, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), solid=is_solid).add_to(link)
        box((0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), solid=is_solid).add_to(link)
        assert [element.tag for element in link] == tags


def test_a_gripper_needs_a_link_to_sit_on() -> None:
    from bulletarm_gym.robots.ur5 import FLANGE, JAW

    with pytest.raises(ValueError, match="no link 'hand'"):
        JAW.fitted(ROBOTS["ur5"].load, "hand", FLANGE)


# Models of users


def write_arm(folder: Path, mesh: str) -> Path:
    """Write a model of one link with a mesh, as a ROS package has it."""
    package = folder / "my_arm"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "meshes" / "base.obj").write_text("v 0 0 0\nf 1 1 1\n")
    visual = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    path = package / "urdf" / "arm.urdf"
    path.write_text(f'<robot name="arm"><link name="base">{visual}</link></robot>')
    return path


@pytest.mark.parametrize(
    "mesh", ["package://my_arm/meshes/base.obj", "package://meshes/base.obj", "../meshes/base.obj"]
)
def test_meshes_of_a_model_are_found(mesh: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_arm(tmp_path, mesh)
    monkeypatch.chdir(tmp_path)
    for source in (path, str(path.relative_to(tmp_path))):
        (found,) = (Path(element.get("filename", "")) for element in read_urdf(source).iter("mesh"))
        assert found.is_absolute() and found.samefile(tmp_path / "my_arm" / "meshes" / "base.obj")


def test_a_file_url_is_a_path(tmp_path: Path) -> None:
    path = write_arm(tmp_path, f"file://{tmp_path}/my_arm/meshes/base.obj")
    (mesh,) = read_urdf(path).iter("mesh")
    assert mesh.get("filename") == f"{tmp_path}/my_arm/meshes/base.obj"


@pytest.mark.parametrize("mesh", ["package://other_arm/meshes/base.obj", "meshes/base.obj"])
def test_a_mesh_that_is_missing_is_named(mesh: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"the mesh {mesh!r} .*my_arm/urdf is not there"):
        read_urdf(write_arm(tmp_path, mesh))


def test_what_is_no_urdf_is_named(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text("<robot")
    with pytest.raises(ValueError, match=r"arm\.urdf, which is not XML"):
        read_urdf(tmp_path / "arm.urdf")


@pytest.mark.parametrize("source", [KUKA, PANDA], ids=["jaw", "own hand"])
def test_fingers_that_end_before_the_stroke_are_refused(source: RobotModel) -> None:
    wider = replace(source.gripper, stroke=0.1)
    with pytest.raises(ValueError, match=r"stroke of 0\.1 m, got 0\.04"):
        make_env(PICKING, robot=replace(source, name="wide", gripper=wider))


def test_joints_that_are_missing_are_named() -> None:
    with pytest.raises(ValueError, match="has no joint 'lbr_iiwa_joint_9'"):
        make_env(PICKING, robot=replace(KUKA, joints=("lbr_iiwa_joint_9",)))


@pytest.mark.parametrize("env_id", PLAIN_IDS)
def test_start_distributions_do_not_depend_on_the_arm(make: Make, env_id: str) -> None:
    starts = set()
    for name in ROBOTS:
        env = make(env_id, robot=name, obs_size=16)
        for seed in range(2):
            env.reset(seed=seed)
            starts.add((seed, tuple(item.pose for item in env.scene)))
    assert len(starts) == 2


# Torques


def test_torques_agree_with_the_simulator(arm_env: ManipulationEnv, robot: Robot) -> None:
    """Bullet's inverse dynamics counts the fingers where they are, ours at the tool."""
    world, slots = arm_env.scene.world, list(robot._arm.slots)
    rng, count = np.random.default_rng(0), len(robot.body.joints)
    for _ in range(10):
        positions, rates, accelerations = np.array(world.joints[robot.body.index]), *np.zeros((2, count))
        positions[slots] += rng.uniform(-0.3, 0.3, len(slots))
        rates[slots], accelerations[slots] = rng.uniform((-1.0, -5.0), (1.0, 5.0), (len(slots), 2)).T
        motion = (positions, rates, accelerations)
        expected = world.client.calculateInverseDynamics(robot.body.id, *(part.tolist() for part in motion))
        torques = robot.dynamics.torques(*(part[slots] for part in motion))
        assert torques == pytest.approx(np.array(expected)[slots], abs=0.1)


def test_motions_take_longer_with_less_torque_and_more_load(robot: Robot) -> None:
    start = np.array(robot.joint_positions)
    path = np.array([start, robot.inverse_kinematics(Pose.planar(0.45, 0.0, 0.25))])
    limits = np.array(robot.model.torques)
    steps = [
        robot.dynamics.least_steps(path, share * limits, load) for share, load in ((1, 0), (1, 2), (0.5, 0))
    ]
    assert steps[0] < steps[1] and steps[0] < steps[2]


def test_motions_with_less_time_to_speed_up_take_longer(robot: Robot) -> None:
    start = np.array(robot.joint_positions)
    path = np.array([start, robot.inverse_kinematics(Pose.planar(0.45, 0.0, 0.25))])
    limits = np.array(robot.model.torques)
    steps = [robot.dynamics.least_steps(path, limits, 0.0, rise) for rise in (0.5, 0.25, 0.1)]
    assert steps[0] < steps[1] < steps[2]


def test_a_base_may_be_turned(name: str) -> None:
    """The whole arm turned about the vertical reaches the turned poses with the same joint positions."""
    model, yaw = ROBOTS[name], math.pi / 3.0
    turn = Pose.planar(0.0, 0.0, 0.0, yaw)
    turned = replace(model, base=turn.compose(model.base))
    for x, y, z in itertools.product((0.35, 0.55), (-0.15, 0.0, 0.15), (0.05, 0.2)):
        pose = Pose.planar(x, y, z, 0.3)
        joints, error = model.inverse(pose)
        others, other_error = turned.inverse(turn.compose(pose))
        assert max(error, other_error) <= POSITION_TOLERANCE
        np.testing.assert_allclose(others, joints, atol=1e-6)


def test_moves_keep_to_the_straight_line(robot: Robot) -> None:
    """Near a joint limit of the wrist the elbow would swing by centimetres: such a move is refused."""
    chain, rng, tried = robot.model.chain, np.random.default_rng(0), 0
    for _ in range(300):
        position = rng.uniform((0.32, -0.13, 0.03), (0.58, 0.13, 0.23))
        start = Pose.planar(*position, rng.uniform(-math.pi, math.pi))
        shift, turn = rng.uniform(-0.03, 0.03, 3), rng.uniform(-0.7, 0.7)
        end = Pose.planar(*(position + shift), start.yaw + turn)
        if not robot.reaches(start):
            continue
        robot.home(start)
        if not robot.can_move_to(end):
            continue
        leaves = robot.wrist_room(end) > robot.wrist_room()
        stops = [robot.joint_positions, *robot._line(start, end), robot.inverse_kinematics(end)]
        path = [
            chain.forward(joints).position for joints in interpolate_path(stops, np.linspace(0.0, 1.0, 41))
        ]
        off = max(math.dist(point, place(point, position, position + shift)) for point in path)
        assert off < (0.03 if leaves else 0.012)
        tried += 1
    assert tried > 200


def place(point: Sequence[float], start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the nearest point of a line."""
    way = end - start
    return start + way * np.clip((point - start) @ way / (way @ way), 0.0, 1.0)


@pytest.mark.parametrize("mode", ["fast", "slow"])
def test_a_load_is_carried_to_where_it_was_sent(make: Make, name: str, mode: str) -> None:
    env = make(PICKING, robot=name, physics_mode=mode, fast_mode=False)
    env.reset(seed=0)
    env.scene["cube"].set_properties(mass=0.2)
    grasp_with_the_expert(env)
    for goal in (MIDDLE, Pose.planar(0.5, 0.08, 0.2, 0.6), Pose.planar(0.4, -0.08, 0.1, -0.6)):
        move(env, goal)
        assert far(env.scene.robot.pose, goal) < 3e-3 and env.scene.robot.held is not None
