"""Open-loop control: actions, motions, heights of targets without z, and in-hand images."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import digest

from bulletarm_gym.config import Context, EnvConfig
from bulletarm_gym.control import Grasp, PickPlace
from bulletarm_gym.control.open_loop import measure_grasp, place_height
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose, euler_angles, euler_pose, matrix, wrap_angle
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.images import projections, rotated_crop

Make = Callable[..., ManipulationEnv]

STACKING = "BulletArm/OpenLoopBlockStacking-v0"
HOUSE = "BulletArm/OpenLoopHouseBuilding1-v0"
CUBE = 0.03
CENTRE, EXTENT = (0.45, 0.0), 0.4
PIXEL = EXTENT / 128


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    env = make(STACKING)
    env.reset(seed=0)
    return env


def lay_out(env: ManipulationEnv, *poses: Pose) -> None:
    """Put the cubes at poses, and those without a pose aside, one on another."""
    env.reset(seed=0)
    aside = [Pose((0.28, -0.17, CUBE * (0.5 + k))) for k in range(4)]
    for obj, pose in zip(env.scene, [*poses, *aside], strict=False):
        obj.place(pose)


def act(env: ManipulationEnv, primitive: str, position: Any, rotation: Any = (0.0, 0.0, 0.0)) -> Any:
    return env.step(env.encode_action(PickPlace(primitive, position, rotation)))


def pick(env: ManipulationEnv, x: float, y: float) -> Any:
    act(env, "pick", (x, y, 0.0))
    assert env.scene.held is not None
    return env.scene.held


def height_at(env: ManipulationEnv, primitive: str, x: float, y: float) -> float:
    """Return the decoded height (m) of a pick or place without z."""
    return float(env.decode_action(env.encode_action(PickPlace(primitive, (x, y, 0.0)))).position[2])


# Actions


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("sequence", ["xy", "rxy", "ypx", "yprx", "xyzrrr", "rrrzyxp", "rxyrzpr"])
def test_encode_inverts_decode(env: ManipulationEnv, sequence: str, half: bool) -> None:
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


def test_decode_returns_physical_units(make: Make) -> None:
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


def test_rotations_are_about_z_then_the_rotated_y_then_the_rotated_x() -> None:
    theta, phi, psi = 0.7, 0.4, -0.3
    axes = [np.eye(3) for _ in range(3)]
    for turn, (i, j), angle in zip(axes, ((0, 1), (2, 0), (1, 2)), (theta, phi, psi), strict=True):
        turn[[i, j], [i, j]], turn[i, j], turn[j, i] = math.cos(angle), -math.sin(angle), math.sin(angle)
    pose = PickPlace("pick", (0.0, 0.0, 0.0), (theta, phi, psi)).pose
    np.testing.assert_allclose(matrix(pose), axes[0] @ axes[1] @ axes[2], atol=1e-12)
    assert euler_angles(pose.orientation) == pytest.approx((psi, phi, theta))


@pytest.mark.parametrize("turns", [-2, -1, 1, 2])
def test_encode_brings_angles_into_range(make: Make, turns: int) -> None:
    """A rotation by pi about the gripper's axis exchanges its fingers."""
    env = make(STACKING, action_sequence="xyzrrr")
    move = PickPlace("pick", (0.4, 0.0, 0.1), (0.7 + turns * math.pi, 0.2, -0.3))
    same = env.decode_action(env.encode_action(move))
    assert 0.0 <= same.rotation[0] <= math.pi
    flip = Pose.planar(0.0, 0.0, 0.0, turns * math.pi)
    np.testing.assert_allclose(matrix(same.pose), matrix(move.pose.compose(flip)), atol=1e-6)


def test_encode_clips_and_rejects_an_unknown_primitive(env: ManipulationEnv) -> None:
    assert env.encode_action(PickPlace("place", (9.0, -9.0, 0.1))).tolist() == [1.0, 1.0, -1.0, -1.0]
    with pytest.raises(ValueError, match=r"primitive .*'push'"):
        env.encode_action(PickPlace("push", (0.4, 0.0, 0.1)))


def test_action_without_p_picks_when_empty_and_places_when_holding(make: Make) -> None:
    env = make(STACKING, action_sequence="xyr")
    env.reset(seed=0)
    moves = []
    for _ in range(4):
        action = env.expert_action()
        moves.append((env.decode_action(action).primitive, env.scene.held is not None))
        env.step(action)
    assert moves == [("pick", False), ("place", True)] * 2


def test_pick_while_holding_and_place_while_empty_change_nothing(env: ManipulationEnv) -> None:
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


# Motion


def test_pick_and_place_move_a_cube_to_the_target(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2, 0.4))
    cube, *others = env.scene
    before = [obj.pose.position for obj in others]
    observation, *_ = act(env, "pick", (0.5, 0.1, 0.0), (0.4, 0.0, 0.0))
    tool = env.scene.robot.pose
    assert env.scene.held is cube and observation["holding"] == 1.0
    assert tool.position == pytest.approx((0.45, 0.0, 0.4), abs=1e-3)
    assert math.dist(cube.pose.position, tool.position) < 2e-3
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
def test_tilted_pick_holds_a_cube_upright(make: Make, fast: bool) -> None:
    env = make("BulletArm/OpenLoopRampBlockStacking-v0", fast_mode=fast)
    env.reset(seed=1)
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


@pytest.mark.parametrize("half", [True, False])
def test_waypoints_become_actions(make: Make, half: bool) -> None:
    """The first with a finish counts; the grasped object has the same target with the fingers exchanged."""
    env = make(STACKING, half_rotation=half)
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    target = Pose.planar(0.505, 0.1, CUBE / 2, -0.2)
    plan = [Waypoint(Pose.planar(0.3, 0.0, 0.1), OPEN), Waypoint(target, OPEN, finish=CLOSED)]
    move = env.tracker.next_move(iter(plan))
    assert move.primitive == "pick" and move.position == pytest.approx(target.position)
    assert move.rotation[0] == pytest.approx(-0.2 + math.pi * half)
    cube, tool = pick(env, 0.5, 0.11), env.scene.robot.pose
    assert abs(cube.pose.y - tool.y) > 5e-3
    spot, carried = Pose.planar(0.4, 0.0, 0.1, -0.3), tool.inverse().compose(cube.pose)
    place = env.tracker.towards(Waypoint(spot, CLOSED, finish=OPEN))
    goal, wanted = env.control.executed(place).compose(carried), spot.compose(carried)
    assert place.primitive == "place" and goal.position == pytest.approx(wanted.position)
    assert wrap_angle(goal.yaw - wanted.yaw, math.pi) == pytest.approx(0.0, abs=1e-9)


# Heights of actions without z


def test_pick_height_is_half_a_cube_below_the_highest_point(env: ManipulationEnv) -> None:
    tower = [Pose.planar(0.4, -0.1, (level + 0.5) * CUBE) for level in range(2)]
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2), *tower)
    points = ((0.5, 0.1), (0.4, -0.1), (0.5, -0.1), (0.65, 0.2))
    heights = [height_at(env, "pick", *point) for point in points]
    assert heights == pytest.approx([CUBE / 2, 1.5 * CUBE, 0.005, 0.005], abs=1e-3)


def test_place_height_depends_on_the_highest_point_under_the_object(make: Make) -> None:
    env = make(HOUSE, in_hand_size=16)
    env.reset(seed=0)
    roof = env.scene["triangle"]
    for number, obj in enumerate(env.scene):
        obj.place(Pose.planar(0.3, 0.1 - 0.09 * number, CUBE / 2))
    roof.place(Pose.planar(0.55, 0.0, CUBE / 2, 0.0))
    assert pick(env, 0.55, 0.0) is roof
    level = env.scene.robot.pose.z - roof.lowest + env.task.grasp_params.place_offset
    points = ((0.5, 0.0), (0.3, 0.1), (0.3 + CUBE / 2 + 0.009, 0.1), (0.3 + CUBE + 0.006, 0.1))
    heights = [height_at(env, "place", x, y) for x, y in points]
    assert heights == pytest.approx([level, level + CUBE, level + CUBE, level], abs=1e-3)


def test_place_height_follows_from_measurements_until_the_gripper_is_empty(env: ManipulationEnv) -> None:
    """An object from a stack is measured. Its simulated pose and shape are not used."""
    lay_out(env, Pose.planar(0.4, -0.1, CUBE / 2), Pose.planar(0.4, -0.1, 1.5 * CUBE))
    act(env, "pick", (0.5, 0.0, 0.0))
    assert env.control.memory is None
    held = pick(env, 0.4, -0.1)
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
    pick(env, 0.5, 0.1)
    known = env.control.memory
    act(env, "pick", (0.4, 0.0, 0.0))  # ignored
    assert known and env.control.memory == known
    act(env, "place", (0.4, 0.0, 0.0))
    assert env.scene.held is None and env.control.memory is None


def square(height: float, middle: tuple[float, float], ground: float = 0.0) -> ElevationMap:
    """Return the heightmap of a square of 4 cm on level ground."""
    axis = (np.arange(128) + 0.5) * PIXEL - EXTENT / 2.0
    inside = [np.abs(axis + offset - at) <= 0.02 for offset, at in zip(CENTRE, middle, strict=True)]
    return ElevationMap(np.where(np.outer(*inside), height, ground).astype(np.float32), CENTRE, EXTENT)


@pytest.mark.parametrize(("yaw", "ground"), [(0.0, 0.0), (0.6, 0.05), (-2.5, 0.0)])
def test_grasp_is_measured_where_the_pick_lowered_the_heightmap(yaw: float, ground: float) -> None:
    """Another object that moved at the same time does not count."""
    before, after = (square(height, (0.5, 0.05), ground) for height in (ground + 0.03, ground))
    before.heights[10:20, 10:20] = 0.1
    grasp = measure_grasp(before, after, Pose.planar(0.51, 0.05, ground + 0.02, yaw))
    assert grasp is not None and grasp.height == pytest.approx(0.02, abs=1e-6)
    middle = Pose.planar(0.51, 0.05, 0.0, yaw).transform((grasp.x, grasp.y, 0.0))
    assert middle[:2] == pytest.approx((0.5, 0.05), abs=PIXEL)
    side = 0.04 * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
    assert side - 3 * PIXEL < grasp.length < side and side - 3 * PIXEL < grasp.width < side
    assert measure_grasp(before, before, Pose.planar(0.5, 0.05, 0.02)) is None
    assert measure_grasp(before, after, Pose.planar(0.4, 0.15, 0.02)) is None


@pytest.mark.parametrize(("yaw", "height"), [(0.0, 0.053), (math.pi / 2, 0.023)])
def test_footprint_rotates_with_the_target(yaw: float, height: float) -> None:
    grasp, target = Grasp(0.02, 0.0, 0.0, 0.01, 0.08), Pose.planar(0.5, 0.05, 0.0, yaw)
    assert place_height(square(0.03, (0.5, 0.0)), target, grasp, 0.003) == pytest.approx(height)


# Observation


def test_heightmap_is_metric_and_shows_the_whole_workspace(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.55, 0.1, CUBE / 2, 0.3))
    image = env.observe()["heightmap"]
    mask = np.zeros((128, 128), bool)
    mask[64:, 64:] = image[0, 64:, 64:] > 0.001
    at = np.argwhere(mask).mean(axis=0)
    np.testing.assert_allclose((at + 0.5) * PIXEL + (0.25, -0.2), (0.55, 0.1), atol=PIXEL / 2)
    assert mask.sum() * PIXEL**2 == pytest.approx(CUBE**2, rel=0.1)
    assert image[0][mask].max() == pytest.approx(CUBE, abs=1e-5)


def slow_crop(view: ElevationMap, tool: Pose, size: int) -> np.ndarray:
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


def slow_projections(view: ElevationMap, tool: Pose, size: int) -> np.ndarray:
    """Return the sums along each axis of the voxels below the surface."""
    n, full = len(view.heights), np.zeros((size,) * 3)
    for index in itertools.product(range(size), repeat=3):
        i, j, k = ((number - (size - 1) / 2) * view.resolution for number in index)
        point = tool.transform((i, j, k))
        a, b = (math.floor(at) for at in view.pixels(np.array(point)) + 0.5)
        full[index] = 0 <= a < n and 0 <= b < n and point[2] < view.heights[a, b]
    return np.stack([full.sum(axis=axis) for axis in range(3)]) * view.resolution


@pytest.mark.parametrize("size", [8, 9])
@pytest.mark.parametrize("at", [(0.4437, 0.013), (0.26, 0.19), (0.65, -0.2)])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.3, -0.5, 2.0)])
def test_in_hand_images_equal_slow_ones(angles: Any, at: tuple[float, float], size: int) -> None:
    heights = np.random.default_rng(0).uniform(0.0, 0.05, (20, 20)).astype(np.float32)
    view, tool = ElevationMap(heights, CENTRE, EXTENT), euler_pose((*at, 0.021), angles)
    np.testing.assert_allclose(rotated_crop(view, tool, size), slow_crop(view, tool, size), atol=1e-6)
    np.testing.assert_allclose(projections(view, tool, size), slow_projections(view, tool, size), atol=1e-6)


@pytest.mark.parametrize("sequence", ["pxyr", "pxyzrrr"])
def test_in_hand_shows_the_heightmap_before_the_pick(make: Make, sequence: str) -> None:
    """It stays after a failed pick, and is zero after a place, a pick of nothing and a reset."""
    env = make(STACKING, action_sequence=sequence)
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    before = env.observe()
    assert not before["in_hand"].any()
    move = PickPlace("pick", (0.5, 0.12, CUBE + 0.01), (0.4, 0.3, -0.2))
    move = env.decode_action(env.encode_action(move))
    after, *_ = env.step(env.encode_action(move))
    shown = slow_projections if sequence == "pxyzrrr" else slow_crop
    expected = shown(ElevationMap(before["heightmap"][0], CENTRE, EXTENT), move.pose, 24)
    np.testing.assert_allclose(after["in_hand"], expected, atol=1e-5)
    assert after["in_hand"].any()
    if env.scene.held is None:
        ignored, *_, info = act(env, "place", (0.5, 0.15, 0.0))
        assert info["ignored"] and np.array_equal(ignored["in_hand"], after["in_hand"])
    end, *_ = act(env, "pick" if env.scene.held is None else "place", (0.4, 0.0, 0.1))
    assert not end["in_hand"].any() and not env.reset(seed=0)[0]["in_hand"].any()
