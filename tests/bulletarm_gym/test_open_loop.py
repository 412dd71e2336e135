"""Open-loop control: actions, motions, heights, in-hand images; the same observations from point clouds."""

import itertools
import math

import numpy as np
import pytest
from rollouts import STACKING, digest
from scipy.spatial.transform import Rotation

from bulletarm_gym import real_arm
from bulletarm_gym.config import Context, EnvConfig
from bulletarm_gym.control import PickPlace
from bulletarm_gym.geometry import Pose, euler_angles, matrix, wrap_angle
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.cameras import SIDE_PIXELS, side_cameras

CUBE = 0.03
CENTRE, EXTENT = (0.45, 0.0), 0.4


@pytest.fixture
def env(make):
    return make(STACKING, seed=0)


def lay_out(env, *poses):
    """Put the cubes at poses, and those without a pose aside, one on another."""
    env.reset(seed=0)
    aside = [Pose((0.28, -0.17, CUBE * (0.5 + k))) for k in range(4)]
    for obj, pose in zip(env.scene, [*poses, *aside], strict=False):
        obj.place(pose)


def act(env, primitive, position, rotation=(0.0, 0.0, 0.0)):
    return env.step(env.encode_action(PickPlace(primitive, position, rotation)))


def height_at(env, primitive, x, y):
    """Return the decoded height (m) of a pick or place without z."""
    return float(env.decode_action(env.encode_action(PickPlace(primitive, (x, y, 0.0)))).position[2])


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("sequence", ["xy", "yprx", "xyzrrr", "rxyrzpr"])
def test_encode_inverts_decode(env, sequence, half):
    context = Context("open_loop", env.task.defaults)
    config = EnvConfig.of(context, {"action_sequence": sequence, "half_rotation": half})
    control, view = type(env.control)(config, env.control.robot, env.task.grasp_params), env.look()
    rng = np.random.default_rng(0)
    corners = [np.full(len(sequence), sign) for sign in (-1.0, 0.0, 1.0)]
    for action in [*corners, *rng.uniform(-1.0, 1.0, (3, len(sequence)))]:
        move = control.decode_action(action, view)
        again = control.encode_action(move)
        is_p = np.array([name == "p" for name in sequence])
        expected = np.where(is_p, np.where(action < 0.0, -1.0, 1.0), action)
        np.testing.assert_allclose(again, expected, atol=1e-6)
        assert again.dtype == np.float32 and control.decode_action(again, view).primitive == move.primitive


def test_decode_returns_physical_units(make):
    workspace = [[0.25, 0.65], [-0.2, 0.2], [0.05, 1.0]]
    env = make(STACKING, action_sequence="pxyzrrr", half_rotation=False, workspace=workspace)
    low, middle, high = (env.decode_action(np.full(7, value)) for value in (-1.0, 0.0, 1.0))
    assert [move.primitive for move in (low, middle, high)] == ["pick", "place", "place"]
    assert low.position == pytest.approx((0.25, -0.2, 0.05))
    assert high.position == pytest.approx((0.65, 0.2, 0.35))
    assert low.rotation == pytest.approx((-math.pi, -math.pi / 4, -math.pi / 4))
    assert high.rotation == pytest.approx((math.pi, math.pi / 4, math.pi / 4))
    half = make(STACKING)
    assert [half.decode_action([0, 0, 0, r]).rotation[0] for r in (-1, 0.5)] == [0.0, 0.75 * math.pi]


def test_rotations_are_about_z_then_the_rotated_y_then_the_rotated_x():
    angles = (0.7, 0.4, -0.3)
    pose = PickPlace("pick", (0.0, 0.0, 0.0), angles).pose
    np.testing.assert_allclose(matrix(pose), Rotation.from_euler("ZYX", angles).as_matrix(), atol=1e-12)
    assert euler_angles(pose.orientation) == pytest.approx(angles[::-1])


def test_encode_brings_angles_into_range(make):
    """A rotation by pi about the gripper's axis exchanges its fingers."""
    env = make(STACKING, action_sequence="xyzrrr")
    for turns in (-2, 1):
        move = PickPlace("pick", (0.4, 0.0, 0.1), (0.7 + turns * math.pi, 0.2, -0.3))
        same = env.decode_action(env.encode_action(move))
        assert 0.0 <= same.rotation[0] <= math.pi
        flip = Pose.planar(0.0, 0.0, 0.0, turns * math.pi)
        np.testing.assert_allclose(matrix(same.pose), matrix(move.pose.compose(flip)), atol=1e-6)


def test_encode_clips_positions_and_rejects_an_unknown_primitive(env):
    assert env.encode_action(PickPlace("place", (9.0, -9.0, 0.1))).tolist() == [1.0, 1.0, -1.0, -1.0]
    with pytest.raises(ValueError, match=r"^primitive must be .*'push'"):
        PickPlace("push", (0.4, 0.0, 0.1))


def test_action_without_p_picks_when_empty_and_places_when_holding(make):
    env = make(STACKING, action_sequence="xyr", seed=0)
    moves = []
    for _ in range(4):
        action = env.expert_action()
        moves.append((env.decode_action(action).primitive, env.scene.held is not None))
        env.step(action)
    assert moves == [("pick", False), ("place", True)] * 2


def test_pick_while_holding_and_place_while_empty_change_nothing(env):
    before = env.observe()
    observation, reward, terminated, truncated, info = act(env, "place", (0.45, 0.0, 0.0))
    assert info["ignored"] and (reward, terminated, truncated) == (0.0, False, False)
    assert digest(observation) == digest(before)
    *_, info = env.step(env.expert_action())
    assert not info["ignored"] and env.scene.held is not None
    world, before = env.scene.world.get_state(), env.observe()
    observation, *_, info = act(env, "pick", (0.3, 0.1, 0.0))
    assert info["ignored"] and env.scene.world.get_state() == world and env.get_state().steps == 3
    assert digest(observation) == digest(before)


def test_pick_and_place_move_a_cube_to_the_target(env):
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2, 0.4))
    cube, *others = env.scene
    before = [obj.pose.position for obj in others]
    observation, *_ = act(env, "pick", (0.5, 0.1, 0.0), (0.4, 0.0, 0.0))
    assert env.scene.held is cube and observation["holding"] == 1.0
    for pose in (env.scene.robot.pose, cube.pose):
        assert pose.position == pytest.approx((0.45, 0.0, 0.4), abs=2e-3)
    assert observation["heightmap"][0, 20:, 30:].max() == 0.0  # neither the arm nor the cube is visible
    observation, *_ = act(env, "place", (0.4, -0.05, 0.0), (1.3, 0.0, 0.0))
    assert env.scene.held is None and observation["holding"] == 0.0
    assert cube.pose.position == pytest.approx((0.4, -0.05, CUBE / 2), abs=1.5e-3)
    assert wrap_angle(cube.pose.yaw - 1.3, math.pi / 2) == pytest.approx(0.0, abs=0.03)
    *_, info = act(env, "pick", (0.55, 0.1, 0.0))  # of nothing
    assert not info["ignored"] and env.scene.held is None
    assert env.scene.robot.opening_ratio == pytest.approx(1.0)
    np.testing.assert_allclose([obj.pose.position for obj in others], before, atol=1e-3)


@pytest.mark.parametrize("fast", [True, False])
def test_tilted_pick_holds_a_cube_upright(make, fast):
    env = make("BulletArm/OpenLoopRampBlockStacking-v0", fast_mode=fast, seed=1)
    cube = max(env.scene, key=lambda obj: obj.pose.tilt)
    assert cube.pose.tilt > 0.15
    quarters = (cube.pose.compose(Pose.planar(0.0, 0.0, 0.0, turn * math.pi / 2)) for turn in range(4))
    angles = [euler_angles(pose.orientation) for pose in quarters]
    psi, phi, theta = next(each for each in angles if 0.0 <= each[2] < math.pi)
    act(env, "pick", cube.pose.position, (theta, phi, psi))
    assert env.scene.held is cube and cube.pose.tilt < 0.2
    spot = env.scene.surface.goal_site((CUBE, CUBE), np.random.default_rng(0)).position
    act(env, "place", (spot[0], spot[1], CUBE / 2 + 2e-3))
    assert cube.pose.position == pytest.approx((spot[0], spot[1], CUBE / 2), abs=0.01)
    assert cube.pose.tilt < 0.01


def test_pick_height_is_half_a_cube_below_the_highest_point(env):
    tower = [Pose.planar(0.4, -0.1, (level + 0.5) * CUBE) for level in range(2)]
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2), *tower)
    points = ((0.5, 0.1), (0.4, -0.1), (0.5, -0.1), (0.65, 0.2))
    heights = [height_at(env, "pick", *point) for point in points]
    assert heights == pytest.approx([CUBE / 2, 1.5 * CUBE, 0.005, 0.005], abs=1e-3)


def test_place_height_follows_from_measurements_until_the_gripper_is_empty(env):
    """Simulated pose and shape are not used. A memory of measurements is part of the state."""
    lay_out(env, Pose.planar(0.4, -0.1, CUBE / 2), Pose.planar(0.4, -0.1, 1.5 * CUBE))
    assert env.control.memory is None
    act(env, "pick", (0.4, -0.1, 0.0))
    held, known = env.scene.held, env.control.memory
    assert env.get_state().control == known and all(type(number) is float for number in known)
    level = CUBE / 2 + env.task.grasp_params.place_offset
    assert height_at(env, "place", 0.5, 0.1) == pytest.approx(level, abs=1.5e-3)
    assert height_at(env, "place", 0.4, -0.1) == pytest.approx(level + CUBE, abs=1.5e-3)
    before = height_at(env, "place", 0.4, 0.0)
    held.place(Pose((0.7, 0.3, 0.9), (0.6, 0.0, 0.0, 0.8)))
    assert height_at(env, "place", 0.4, 0.0) == before
    env.control.memory = None  # without measurements it counts as a cube
    level = env.task.grasp_params.pick_offset + env.task.grasp_params.place_offset
    assert height_at(env, "place", 0.4, 0.0) == pytest.approx(level)
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    for primitive, y, is_known in (("pick", 0.1, True), ("pick", 0.0, True), ("place", 0.0, False)):
        act(env, primitive, (0.5, y, 0.0))
        assert (env.scene.held is not None) == (env.control.memory is not None) == is_known


def slow_crop(view, tool, size):
    """Return the bilinear interpolation of each pixel."""
    image = np.zeros((1, size, size))
    for i, j in itertools.product(range(size), repeat=2):
        u, v = ((k - (size - 1) / 2) * view.resolution for k in (i, j))
        point = np.array(Pose.planar(*tool.position, tool.yaw).transform((u, v, 0.0)))
        row, column = view.pixels(point)
        for a, b in itertools.product(*((math.floor(at), math.floor(at) + 1) for at in (row, column))):
            if 0 <= a < len(view.heights) and 0 <= b < len(view.heights):
                image[0, i, j] += view.heights[a, b] * (1 - abs(row - a)) * (1 - abs(column - b))
    return image


def slow_projections(view, tool, size):
    """Return the sums along each axis of the voxels below the surface."""
    n, full = len(view.heights), np.zeros((size,) * 3)
    for index in itertools.product(range(size), repeat=3):
        i, j, k = ((number - (size - 1) / 2) * view.resolution for number in index)
        point = tool.transform((i, j, k))
        a, b = (math.floor(at) for at in view.pixels(np.array(point)) + 0.5)
        full[index] = 0 <= a < n and 0 <= b < n and point[2] < view.heights[a, b]
    return np.stack([full.sum(axis=axis) for axis in range(3)]) * view.resolution


@pytest.mark.parametrize("sequence", ["pxyr", "pxyzrrr"])
def test_in_hand_shows_the_heightmap_before_the_pick(make, sequence):
    """As computed for a real arm. It is zero after a place, a pick of nothing and a reset."""
    env = make(STACKING, action_sequence=sequence)
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    before = env.observe()
    assert not before["in_hand"].any()
    move = PickPlace("pick", (0.5, 0.12, CUBE + 0.01), (0.4, 0.3, -0.2))
    move = env.decode_action(env.encode_action(move))
    after, *_ = env.step(env.encode_action(move))
    tilts = sequence == "pxyzrrr"
    shown = slow_projections if tilts else slow_crop
    expected = shown(ElevationMap(before["heightmap"][0], CENTRE, EXTENT), move.pose, 24)
    np.testing.assert_allclose(after["in_hand"], expected, atol=1e-5)
    own = real_arm.in_hand_image(before["heightmap"], move.pose, tilts=tilts)
    np.testing.assert_array_equal(own, after["in_hand"])
    assert after["in_hand"].any()
    end, *_ = act(env, "pick" if env.scene.held is None else "place", (0.4, 0.0, 0.1))
    assert not end["in_hand"].any() and not env.reset(seed=0)[0]["in_hand"].any()


def cloud(env, shows_grasped):
    """Return the points of two depth cameras next to the workspace, without the arm."""
    robot = env.scene.robot
    absent = [robot.body] if shows_grasped or robot.held is None else [robot.body, robot.held]
    cameras = side_cameras(env.scene.config, SIDE_PIXELS)
    return np.concatenate([camera.points(env.scene.world, absent) for camera in cameras])


def test_close_loop_heightmap_equals_the_point_cloud_view(make):
    workspace = [[0.32, 0.6], [-0.1, 0.18], [0.02, 0.2]]
    env = make("BulletArm/CloseLoopBlockStacking-v0", view="point_cloud", workspace=workspace, obs_size=32)
    observation, _ = env.reset(seed=1)
    for _ in range(5):
        points, robot = cloud(env, shows_grasped=True), env.scene.robot
        image = real_arm.close_loop_heightmap(points, robot.pose, robot.opening, workspace, 32)
        assert (image == observation["heightmap"]).all() and image.dtype == np.float32
        observation, *_ = env.step(env.expert_action())
    assert env.scene.held is not None


def test_images_and_heights_equal_those_of_the_environment(make):
    """Heightmaps differ from the orthographic view at edges only."""
    workspace = [[0.25, 0.65], [-0.2, 0.2], [0.01, 1.0]]
    env = make("BulletArm/OpenLoopHouseBuilding1-v0", workspace=workspace)
    params = env.task.grasp_params
    before, _ = env.reset(seed=0)
    for _ in range(2):
        action = env.expert_action()
        move = env.decode_action(action)
        tool = env.control.executed(move)
        maps = [real_arm.elevation_map(before["heightmap"], workspace)]
        height = real_arm.pick_height(maps[0], tool, params.pick_offset)
        assert height == pytest.approx(tool.z)
        after, *_ = env.step(action)
        image = real_arm.in_hand_image(before["heightmap"], move.pose, workspace)
        assert image.any() and (image == after["in_hand"]).all()
        image = real_arm.open_loop_heightmap(cloud(env, shows_grasped=False), workspace)
        difference = np.abs(image - after["heightmap"])
        assert np.median(difference) < 1e-5 and (difference > 1e-3).mean() < 0.03
        maps.append(real_arm.elevation_map(after["heightmap"], workspace))
        grasp = real_arm.measure_grasp(*maps, tool)
        assert grasp is not None and tuple(grasp) == pytest.approx(env.control.memory, abs=1e-4)
        action = env.expert_action()
        tool = env.control.executed(env.decode_action(action))
        height = real_arm.place_height(maps[1], tool, grasp, params.place_offset)
        assert height == pytest.approx(tool.z, abs=1e-4)
        before, *_ = env.step(action)


def test_points_must_be_world_coordinates_in_the_square():
    for points, words in (([0.4, 0.0, 0.0], r"\(3,\)"), ([[450.0, 0.0, 0.0]], r"0\.45 m")):
        with pytest.raises(ValueError, match=f"points .*{words}"):
            real_arm.close_loop_heightmap(points, Pose((0.45, 0.0, 0.2)), 0.05)
    with pytest.raises(ValueError, match=r"points .*0\.4 m"):
        real_arm.open_loop_heightmap([[np.nan, 0.0, 0.0]])
    known, unknown = [[0.45, 0.0, 0.03], [0.5, 0.1, 0.0]], [[np.nan] * 3, [0.45, 0.0, np.inf]]
    assert (real_arm.open_loop_heightmap(known + unknown) == real_arm.open_loop_heightmap(known)).all()
