"""Pick and place: what actions mean, how targets without a height are reached, what is seen."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from rollouts import digest, transcript

import bulletarm_gym
from bulletarm_gym.config import Context, EnvConfig
from bulletarm_gym.control import PickPlace
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose, Vector, euler_angles, euler_pose, matrix, wrap_angle
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.in_hand import projections, rotated_crop

Make = Callable[..., ManipulationEnv]

TASK = "bulletarm_gym.tasks.stacking:BlockStacking"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
HOUSE = "BulletArm/OpenLoopHouseBuilding1-v0"
CUBE = 0.03
RESOLUTION = 0.4 / 128
TILTED = ("xyzrrr", "pxyzrrr", "rrrzyxp", "rxyrzpr", "xyrzrr")
SEQUENCES = [
    *("".join(order) for word in ("xy", "xyr", "pxy", "pxyr") for order in itertools.permutations(word)),
    *TILTED,
]


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    env = make(STACKING)
    env.reset(seed=0)
    return env


def lay_out(env: ManipulationEnv, *poses: Pose) -> None:
    """Put the cubes somewhere, and those that no pose is given for aside, one on another."""
    env.reset(seed=0)
    aside = [Pose((0.28, -0.17, CUBE * (0.5 + k))) for k in range(4)]
    for item, pose in zip(env.scene, [*poses, *aside], strict=False):
        item.place(pose)


def pick_place(env: ManipulationEnv, primitive: str, position: Any, rotation: Any = (0.0, 0.0, 0.0)) -> Any:
    """Act; return what step returns."""
    return env.step(env.encode_action(PickPlace(primitive, position, rotation)))


# Actions


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("half", [True, False])
def test_encode_inverts_decode(make: Make, sequence: str, half: bool) -> None:
    env = make(STACKING)
    env.reset(seed=0)
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


def test_decode_gives_physical_units(make: Make) -> None:
    env = make(STACKING, action_sequence="pxyzrrr", half_rotation=False)
    low, middle, high = (env.decode_action(np.full(7, value)) for value in (-1.0, 0.0, 1.0))
    assert (low.primitive, middle.primitive, high.primitive) == ("pick", "place", "place")
    assert low.position == pytest.approx((0.25, -0.2, 0.0)) and high.position == pytest.approx(
        (0.65, 0.2, 0.3)
    )
    assert low.rotation == pytest.approx((-math.pi, -math.pi / 4, -math.pi / 4))
    assert high.rotation == pytest.approx((math.pi, math.pi / 4, math.pi / 4))
    half = make(STACKING)
    assert half.decode_action([0.0, 0.0, 0.0, -1.0]).rotation == (0.0, 0.0, 0.0)
    assert half.decode_action([0.0, 0.0, 0.0, 0.5]).rotation[0] == pytest.approx(0.75 * math.pi)


def test_z_counts_from_the_floor_of_the_workspace(make: Make) -> None:
    env = make(STACKING, action_sequence="xyzrrr", workspace=[[0.25, 0.65], [-0.2, 0.2], [0.05, 1.0]])
    env.reset(seed=0)
    assert env.decode_action(np.full(6, -1.0)).position[2] == pytest.approx(0.05)
    assert env.observe()["heightmap"].max() == 0.0, "the cubes are below the floor"


def test_rotations_are_about_z_then_the_turned_y_then_the_turned_x() -> None:
    theta, phi, psi = 0.7, 0.4, -0.3
    axes = [np.eye(3) for _ in range(3)]
    for turn, (i, j), angle in zip(axes, ((0, 1), (2, 0), (1, 2)), (theta, phi, psi), strict=True):
        turn[[i, j], [i, j]], turn[i, j], turn[j, i] = math.cos(angle), -math.sin(angle), math.sin(angle)
    pose = PickPlace("pick", (0.0, 0.0, 0.0), (theta, phi, psi)).pose
    np.testing.assert_allclose(matrix(pose), axes[0] @ axes[1] @ axes[2], atol=1e-12)
    assert euler_angles(pose.orientation) == pytest.approx((psi, phi, theta))


@pytest.mark.parametrize("turns", [-2, -1, 1, 2])
def test_encode_brings_angles_into_range(make: Make, turns: int) -> None:
    """By half a turn about its own axis the gripper is the same, its fingers exchanged."""
    env = make(STACKING, action_sequence="xyzrrr")
    move = PickPlace("pick", (0.4, 0.0, 0.1), (0.7 + turns * math.pi, 0.2, -0.3))
    same = env.decode_action(env.encode_action(move))
    assert 0.0 <= same.rotation[0] <= math.pi
    flip = Pose.planar(0.0, 0.0, 0.0, turns * math.pi)
    np.testing.assert_allclose(matrix(same.pose), matrix(move.pose.compose(flip)), atol=1e-6)


def test_encode_clips(env: ManipulationEnv) -> None:
    assert env.encode_action(PickPlace("place", (9.0, -9.0, 0.1))).tolist() == [1.0, 1.0, -1.0, -1.0]


def test_unknown_primitives_are_refused(env: ManipulationEnv) -> None:
    with pytest.raises(ValueError, match="primitive must be 'pick' or 'place', got 'push'"):
        env.encode_action(PickPlace("push", (0.4, 0.0, 0.1)))


@pytest.mark.parametrize("sequence", ["rxyp", "yprx"])
def test_order_of_the_sequence_changes_names_only(make: Make, sequence: str) -> None:
    env, plain = make(STACKING, action_sequence=sequence), make(STACKING)
    plain.reset(seed=3)
    env.reset(seed=3)
    for _ in range(2):
        move = plain.decode_action(plain.expert_action())
        assert digest(*env.step(env.encode_action(move))) == digest(*plain.step(plain.encode_action(move)))


def test_without_p_picks_when_empty_and_places_when_holding(make: Make) -> None:
    env = make(STACKING, action_sequence="xyr")
    env.reset(seed=0)
    seen = []
    for _ in range(4):
        action = env.expert_action()
        seen.append((env.decode_action(action).primitive, env.scene.held is not None))
        env.step(action)
    assert seen == [("pick", False), ("place", True)] * 2


# What is ignored


def test_pick_while_holding_and_place_while_empty_change_nothing(env: ManipulationEnv) -> None:
    before = env.observe()
    observation, reward, terminated, truncated, info = pick_place(env, "place", (0.45, 0.0, 0.0))
    assert info["ignored"] and (reward, terminated, truncated) == (0.0, False, False)
    assert digest(observation) == digest(before)
    *_, info = env.step(env.expert_action())
    assert not info["ignored"] and env.scene.held is not None
    held, world, picture = env.scene.held, env.scene.world.get_state(), digest(env.observe())
    observation, *_, info = pick_place(env, "pick", (0.3, 0.1, 0.0))
    assert info["ignored"] and env.scene.held is held
    assert env.scene.world.get_state() == world and digest(observation) == picture
    assert env.get_state().steps == 3


@pytest.mark.parametrize("tilt", [(math.pi / 4, math.pi / 4), (-math.pi / 4, math.pi / 4)])
def test_what_is_out_of_reach_is_ignored(make: Make, tilt: tuple[float, float]) -> None:
    env = make(STACKING, action_sequence="pxyzrrr", half_rotation=False)
    env.reset(seed=0)
    ignored = []
    for x, theta in itertools.product((0.25, 0.65), np.linspace(-3.0, 3.0, 5)):
        state = env.scene.world.get_state()
        *_, info = pick_place(env, "pick", (x, 0.2, 0.3), (float(theta), *tilt))
        ignored.append(info["ignored"])
        assert not info["ignored"] or env.scene.world.get_state() == state
    assert 0 < sum(ignored) < len(ignored)


# Motion


def test_pick_and_place_move_a_cube_where_they_say(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2, 0.4))
    cube = next(iter(env.scene))
    observation, *_ = pick_place(env, "pick", (0.5, 0.1, 0.0), (0.4, 0.0, 0.0))
    assert env.scene.held is cube and observation["holding"] == 1.0
    hand = env.scene.robot.pose
    assert hand.position == pytest.approx((0.45, 0.0, 0.4), abs=1e-3)
    assert math.dist(cube.pose.position, hand.position) < 2e-3
    observation, *_ = pick_place(env, "place", (0.4, -0.05, 0.0), (1.3, 0.0, 0.0))
    assert env.scene.held is None and observation["holding"] == 0.0
    assert cube.pose.position == pytest.approx((0.4, -0.05, CUBE / 2), abs=1.5e-3)
    assert wrap_angle(cube.pose.yaw - 1.3, math.pi / 2) == pytest.approx(0.0, abs=0.03)
    assert env.scene.robot.opening_ratio == pytest.approx(1.0)


def test_pick_beside_everything_holds_nothing_and_moves_nothing(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    before = [item.pose for item in env.scene]
    observation, *_, info = pick_place(env, "pick", (0.4, 0.0, 0.0))
    assert not info["ignored"] and env.scene.held is None and observation["holding"] == 0.0
    for item, pose in zip(env.scene, before, strict=True):
        assert math.dist(item.pose.position, pose.position) < 1e-3
    assert env.scene.robot.opening_ratio == pytest.approx(1.0)


@pytest.mark.parametrize("fast", [True, False])
def test_tilted_pick_and_upright_place(fast: bool) -> None:
    """A cube on a slope is grasped square on, hangs straight at home, and is put down upright."""
    env = ManipulationEnv(task=TASK, control="open_loop", surface="ramp", fast_mode=fast)
    done = 0
    for seed in range(12):
        env.reset(seed=seed)
        cube = max(env.scene, key=lambda item: item.pose.tilt)
        if cube.pose.tilt < 0.15:
            continue
        pick_place(env, "pick", cube.pose.position, square_on(cube.pose))
        assert env.scene.held is cube
        assert cube.pose.tilt < 0.2  # of 0.5 before: it may turn a little between the fingers
        spot = env.scene.surface.goal_site((CUBE, CUBE), np.random.default_rng(seed)).position
        others = [item.pose.position for item in env.scene if item is not cube]
        if min(math.dist(spot, other) for other in others) < 0.1:
            continue
        pick_place(env, "place", (spot[0], spot[1], CUBE / 2 + 2e-3))
        assert cube.pose.position == pytest.approx((spot[0], spot[1], CUBE / 2), abs=0.01)
        assert cube.pose.tilt < 0.01
        done += 1
    assert done >= 2
    env.close()


def square_on(pose: Pose) -> Vector:
    """Return theta, phi, psi in range with which the gripper grasps a tilted cube."""
    for quarter in range(4):
        turned = pose.compose(Pose.planar(0.0, 0.0, 0.0, quarter * math.pi / 2))
        psi, phi, theta = euler_angles(turned.orientation)
        if 0.0 <= theta < math.pi:
            return (theta, phi, psi)
    raise AssertionError


def test_fast_mode_saves_simulation_and_changes_little(make: Make) -> None:
    ends, counts = [], []
    for fast in (True, False):
        env = make(STACKING, fast_mode=fast)
        env.reset(seed=1)
        client, count = env.scene.world.client, 0
        step = client.stepSimulation

        def counted(step: Callable[[], None] = step) -> None:
            nonlocal count
            count += 1
            step()

        client.stepSimulation = counted
        for _ in range(2):
            env.step(env.expert_action())
        client.stepSimulation = step
        ends.append([item.pose.position for item in env.scene])
        counts.append(count)
    assert 2 * 20 < counts[0] < 2 * 80 < 2 * 150 < counts[1]
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-3)


def test_a_held_cube_is_not_carried_through_a_tower(make: Make) -> None:
    """With the target's way in blocked nothing is jumped over: what is simulated pushes, it does not pass."""
    env = make(STACKING)
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    pick_place(env, "pick", (0.5, 0.1, 0.0))
    held = env.scene.held
    assert held is not None
    for number, item in enumerate(item for item in env.scene if item is not held):
        item.place(Pose.planar(0.4, 0.0, CUBE * (number + 0.5)))
    env.scene.begin()
    start = env.scene.robot.pose
    assert not env.scene.robot._jump(env.scene.robot.inverse_kinematics(Pose.planar(0.4, 0.02, 0.06)))
    assert env.scene.robot.pose == start, "it is back"
    assert env.scene.robot._jump(env.scene.robot.inverse_kinematics(Pose.planar(0.4, 0.1, 0.06)))


# Observation


def test_heightmap_is_metric_and_shows_the_whole_workspace(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.55, 0.1, CUBE / 2, 0.3))
    image = env.observe()["heightmap"]
    assert image.shape == (1, 128, 128)
    mask = np.zeros((128, 128), bool)
    mask[64:, 64:] = image[0, 64:, 64:] > 0.001
    at = np.argwhere(mask).mean(axis=0)
    np.testing.assert_allclose((at + 0.5) * RESOLUTION + (0.25, -0.2), (0.55, 0.1), atol=RESOLUTION / 2)
    assert mask.sum() * RESOLUTION**2 == pytest.approx(CUBE**2, rel=0.1)
    assert image[0][mask].max() == pytest.approx(CUBE, abs=1e-5)


def test_arm_and_held_object_are_not_in_the_heightmap(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2), *(Pose((0.28, -0.17, CUBE * (0.5 + k))) for k in range(3)))
    observation, *_ = pick_place(env, "pick", (0.5, 0.1, 0.0))
    assert env.scene.held is not None
    assert observation["heightmap"][0, 20:, 30:].max() == 0.0


def slow_crop(view: ElevationMap, hand: Pose, size: int) -> np.ndarray:
    """Pixel by pixel: where it is in the world, and the mean of the four pixels around, weighted."""
    heights, n = view.heights.astype(np.float64), len(view.heights)
    image = np.zeros((1, size, size))
    c, s = math.cos(hand.yaw), math.sin(hand.yaw)
    for i, j in itertools.product(range(size), repeat=2):
        u, v = ((k - (size - 1) / 2) * view.resolution for k in (i, j))
        row = (hand.x + c * u - s * v - view.centre[0] + view.extent / 2) / view.resolution - 0.5
        column = (hand.y + s * u + c * v - view.centre[1] + view.extent / 2) / view.resolution - 0.5
        for a, b in itertools.product(
            (math.floor(row), math.floor(row) + 1), (math.floor(column), math.floor(column) + 1)
        ):
            if 0 <= a < n and 0 <= b < n:
                image[0, i, j] += heights[a, b] * (1 - abs(row - a)) * (1 - abs(column - b))
    return image


def slow_projections(view: ElevationMap, hand: Pose, size: int) -> np.ndarray:
    """Voxel by voxel: where it is in the world, and whether that is below the surface."""
    n, full = len(view.heights), np.zeros((size,) * 3)
    for index in itertools.product(range(size), repeat=3):
        x, y, z = hand.transform(tuple((k - (size - 1) / 2) * view.resolution for k in index))  # type: ignore[arg-type]
        a = math.floor((x - view.centre[0] + view.extent / 2) / view.resolution)
        b = math.floor((y - view.centre[1] + view.extent / 2) / view.resolution)
        full[index] = 0 <= a < n and 0 <= b < n and z < view.heights[a, b]
    return np.stack([full.sum(axis=axis) for axis in range(3)]) * view.resolution


@pytest.fixture(scope="module")
def view() -> ElevationMap:
    heights = np.random.default_rng(0).uniform(0.0, 0.05, (20, 20)).astype(np.float32)
    return ElevationMap(heights, (0.45, 0.0), 0.4)


@pytest.mark.parametrize("at", [(0.45, 0.0), (0.431, 0.055), (0.26, 0.19), (0.65, -0.2)])
@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, 0.3, -2.0])
def test_crop_equals_a_slow_one(view: ElevationMap, at: tuple[float, float], yaw: float) -> None:
    hand = Pose.planar(*at, 0.02, yaw)
    for size in (8, 9):
        np.testing.assert_allclose(rotated_crop(view, hand, size), slow_crop(view, hand, size), atol=1e-6)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.3, -0.5, 2.0), (-0.7, 0.7, 0.4)])
@pytest.mark.parametrize("at", [(0.4437, 0.013), (0.26, 0.19)])
def test_projections_equal_slow_ones(view: ElevationMap, angles: Any, at: tuple[float, float]) -> None:
    hand = euler_pose((*at, 0.021), angles)
    for size in (8, 9):
        np.testing.assert_allclose(
            projections(view, hand, size), slow_projections(view, hand, size), atol=1e-6
        )


def test_in_hand_is_what_the_heightmap_showed_at_the_pick(env: ManipulationEnv) -> None:
    before, _ = env.reset(seed=4)
    assert not before["in_hand"].any()
    move = env.decode_action(env.expert_action())
    after, *_ = env.step(env.encode_action(move))
    expected = slow_crop(ElevationMap(before["heightmap"][0], (0.45, 0.0), 0.4), move.pose, 24)
    np.testing.assert_allclose(after["in_hand"], expected, atol=1e-5)
    assert after["in_hand"][0, 12, 12] == pytest.approx(CUBE, abs=1e-4), "a cube in the middle, square on"
    assert after["in_hand"][0, 8:16, 8:16].min() == pytest.approx(CUBE, abs=1e-4)
    placed, *_ = env.step(env.expert_action())
    assert not placed["in_hand"].any()


def test_in_hand_of_a_pick_that_failed_stays_until_the_next_action(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    after, *_ = pick_place(env, "pick", (0.5, 0.15, 0.0))
    assert after["holding"] == 0.0 and after["in_hand"].max() == pytest.approx(CUBE, abs=1e-4)
    ignored, *_, info = pick_place(env, "place", (0.5, 0.15, 0.0))
    assert info["ignored"] and np.array_equal(ignored["in_hand"], after["in_hand"])
    again, *_ = pick_place(env, "pick", (0.4, 0.0, 0.0))
    assert not again["in_hand"].any()
    assert not env.reset(seed=0)[0]["in_hand"].any()


def test_in_hand_with_tilt_is_three_projections(make: Make) -> None:
    env = make(STACKING, action_sequence="pxyzrrr")
    before, _ = env.reset(seed=4)
    move = PickPlace("pick", (0.45, 0.02, 0.03), (0.4, 0.3, -0.2))
    move = env.decode_action(env.encode_action(move))
    after, *_ = env.step(env.encode_action(move))
    assert after["in_hand"].shape == (3, 24, 24) and after["in_hand"].max() > 0.0
    expected = slow_projections(ElevationMap(before["heightmap"][0], (0.45, 0.0), 0.4), move.pose, 24)
    np.testing.assert_allclose(after["in_hand"], expected, atol=1e-6)


def test_in_hand_size(make: Make) -> None:
    env = make(STACKING, in_hand_size=40)
    assert env.reset(seed=0)[0]["in_hand"].shape == (1, 40, 40)
    assert env.observation_space["in_hand"].shape == (1, 40, 40)


def test_state_keeps_the_in_hand_image(make: Make) -> None:
    env, other = make(HOUSE), make(HOUSE, 1)
    env.reset(seed=1)
    observation, *_ = env.step(env.expert_action())
    state = env.get_state()
    other.reset(seed=9)
    other.set_state(state)
    assert digest(other.observe()) == digest(observation)
    assert observation["in_hand"].any()
    assert transcript(other, 6) == transcript(env, 6)


# Experts


@pytest.mark.parametrize("env_id", [STACKING, HOUSE])
@pytest.mark.parametrize(
    "parameters",
    [
        {"action_sequence": "xyzrrr"},
        {"half_rotation": False},
        {"object_scale_range": [0.5, 0.8], "num_objects": 3},
        {"workspace": [[0.3, 0.6], [-0.1, 0.2], [0.0, 0.5]]},
    ],
    ids=str,
)
def test_expert_solves_in_the_papers_steps(make: Make, env_id: str, parameters: dict[str, Any]) -> None:
    env = make(env_id, **parameters)
    optimal = 2 * (env.config.num_objects - 1)
    for seed in range(3):
        env.reset(seed=seed)
        results = [env.step(env.expert_action())[1:3] for _ in range(optimal)]
        assert results == [(0.0, False)] * (optimal - 1) + [(1.0, True)]


@pytest.mark.parametrize("half", [True, False])
def test_waypoints_become_actions(make: Make, half: bool) -> None:
    """The first with a finish counts; what is held comes to the same place with the fingers exchanged."""
    env = make(STACKING, half_rotation=half)
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    target = Pose.planar(0.505, 0.1, CUBE / 2, -0.2)
    plan = [
        Waypoint(Pose.planar(0.3, 0.0, 0.1), OPEN),
        Waypoint(target, OPEN, finish=CLOSED),
        Waypoint(target, CLOSED),
    ]
    move = env.tracker.next_move(iter(plan))
    assert move.primitive == "pick" and move.position == pytest.approx(target.position)
    assert move.rotation[0] == pytest.approx(-0.2 + math.pi * half)
    env.step(env.encode_action(PickPlace("pick", (0.5, 0.11, 0.0))))
    cube, hand = env.scene.held, env.scene.robot.pose
    assert cube is not None and abs(cube.pose.y - hand.y) > 5e-3, "it hangs at one side"
    spot = Pose.planar(0.4, 0.0, 0.1, -0.3)
    carried = hand.inverse().compose(cube.pose)
    pick_place_move = env.tracker.towards(Waypoint(spot, CLOSED, finish=OPEN))
    assert pick_place_move.primitive == "place"
    executed = env.control.executed(pick_place_move)
    goal, wanted = executed.compose(carried), spot.compose(carried)
    assert goal.position == pytest.approx(wanted.position)
    assert wrap_angle(goal.yaw - wanted.yaw, math.pi) == pytest.approx(0.0, abs=1e-9)


def test_fallen_triangle_ends_the_episode(make: Make) -> None:
    env = make(HOUSE)
    env.reset(seed=0)
    roof = env.scene["triangle"]
    roof.place(euler_pose((roof.pose.x, roof.pose.y, CUBE / 2), (math.pi, 0.0, 0.0)))
    *_, reward, terminated, truncated, info = pick_place(env, "place", (0.45, 0.0, 0.0))
    assert (reward, terminated, truncated, info["is_valid"]) == (0.0, True, False, False)


def test_task_of_ones_own() -> None:
    env_id = bulletarm_gym.register_task("StackingOfMine", TASK, control="open_loop")
    assert env_id == "BulletArm/OpenLoopStackingOfMine-v0"
    try:
        env = gymnasium.make(env_id, num_objects=2)
        env.reset(seed=0)
        assert [env.step(env.unwrapped.expert_action())[1] for _ in range(2)] == [0.0, 1.0]
        env.close()
    finally:
        del gymnasium.registry[env_id]
    with pytest.raises(ValueError, match="control"):
        ManipulationEnv(task="bulletarm_gym.tasks.picking:BlockPicking", control="open_loop")
