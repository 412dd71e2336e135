"""Colours, segmentation, pictures and points: against the heightmap and against where things are."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rollouts import advance, digest, make_env, transcript

from bulletarm_gym.config import ParameterError
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations.images import FINGER_COLOUR, GRIPPER
from bulletarm_gym.simulation.shapes import BLUE, RED
from bulletarm_gym.surfaces.flat import FLOOR

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PUSHING = "BulletArm/CloseLoopBlockPushing-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TOP = ["heightmap", "color", "segmentation"]
ALL = [*TOP, {"name": "rgb", "size": 32}, {"name": "point_cloud", "points": 200}, "holding"]
EXTENT, SIZE = 0.45, 128


def colour_of(colour: tuple[float, ...]) -> list[int]:
    return [round(255 * part) for part in colour[:3]]


def show(image: np.ndarray, colour: tuple[float, ...]) -> np.ndarray:
    """Which pixels of (3, size, size) have a colour."""
    return (image == np.array(colour_of(colour))[:, None, None]).all(axis=0)


def centroid(mask: np.ndarray) -> np.ndarray:
    return (np.argwhere(mask).mean(axis=0) - (SIZE - 1) / 2) * EXTENT / SIZE


def test_spaces_are_what_image_networks_take(make: Make, typical_id: str) -> None:
    env = make(typical_id, observation=ALL)
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert observation["color"].shape == (3, 128, 128) and observation["segmentation"].shape == (1, 128, 128)
    assert observation["rgb"].shape == (3, 32, 32) and observation["point_cloud"].shape == (200, 3)
    assert all(values.flags.c_contiguous for values in observation.values())
    assert {observation[name].dtype.name for name in ("color", "segmentation", "rgb")} == {"uint8"}


def test_the_heightmap_is_the_same_with_and_without_colours(make: Make, typical_id: str) -> None:
    env, plain = make(typical_id, observation=TOP), make(typical_id, observation=["heightmap"])
    for seed in range(3):
        seen, heights = env.reset(seed=seed)[0], plain.reset(seed=seed)[0]
        assert np.array_equal(seen["heightmap"], heights["heightmap"])


def test_a_cube_is_where_it_is_in_its_colour(make: Make) -> None:
    env = make(PICKING, observation=TOP)
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.45, 0.0, 0.2, 0.4))
    env.scene["cube"].place(Pose.planar(0.52, 0.06, 0.025, 0.3))
    seen = env.observe()
    fingers = show(seen["color"], tuple(part / 255 for part in FINGER_COLOUR))
    assert np.array_equal(fingers, seen["heightmap"][0] == 0.0)
    assert np.array_equal(fingers, seen["segmentation"][0] == GRIPPER)
    cube = show(seen["color"], RED)
    assert np.array_equal(cube, seen["segmentation"][0] == 1)
    np.testing.assert_allclose(centroid(cube), (0.07, 0.06), atol=EXTENT / SIZE / 2)
    assert np.array_equal(~cube & ~fingers, show(seen["color"], FLOOR.colour))
    assert np.array_equal(seen["segmentation"][0] == 0, show(seen["color"], FLOOR.colour))


def test_a_goal_on_the_ground_is_seen_under_what_lies_on_it(make: Make) -> None:
    env = make(PUSHING, observation=TOP)
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.45, 0.0, 0.2))
    env.scene["goal"].place(Pose.planar(0.5, 0.1, 0.0))
    env.scene["cube"].place(Pose.planar(0.5, 0.1, 0.025))
    seen = env.observe()
    goal, cube = show(seen["color"], BLUE), show(seen["color"], RED)
    area = (EXTENT / SIZE) ** 2
    assert cube.sum() * area == pytest.approx(0.05**2, rel=0.05)
    assert goal.sum() * area == pytest.approx(0.09**2 - 0.05**2, rel=0.05)
    assert np.array_equal(cube, seen["segmentation"][0] == 1) and np.array_equal(
        goal, seen["segmentation"][0] == 2
    )


def test_turning_the_scene_turns_the_colours(make: Make) -> None:
    env = make(PICKING, observation=TOP)
    env.reset(seed=0)
    seen = []
    for turn, x, y in ((0.0, 0.07, 0.04), (math.pi / 2, -0.04, 0.07)):
        env.scene.robot.home(Pose.planar(0.45, 0.0, 0.2, 0.3 + turn))
        env.scene["cube"].place(Pose.planar(0.45 + x, y, 0.025, 0.2 + turn))
        seen.append(env.observe())
    for name in TOP:
        differ = np.rot90(seen[0][name], 1, axes=(1, 2)) != seen[1][name]
        assert differ.mean() < 1e-3, name


def test_open_loop_shows_neither_arm_nor_what_it_holds(make: Make) -> None:
    env = make(STACKING, observation=[*TOP, "holding"])
    before, _ = env.reset(seed=0)
    after, *_ = env.step(env.expert_action())
    assert after["holding"] == 1.0
    held = next(n for n, item in enumerate(env.scene.objects, 1) if item is env.scene.held)
    assert (before["segmentation"] == held).any() and not (after["segmentation"] == held).any()
    assert not (after["segmentation"] == GRIPPER).any()
    assert set(np.unique(before["segmentation"])) == {0, 1, 2, 3, 4}


def test_numbers_follow_roles_not_who_plays_them(make: Make) -> None:
    env = make(STACKING, observation=TOP, object_scale_range=[0.6, 0.7])
    for seed in range(3):
        seen = set(np.unique(env.reset(seed=seed)[0]["segmentation"]))
        assert seen == {0, 1, 2, 3, 4}


def test_points_lie_on_what_the_heightmap_shows(make: Make) -> None:
    env = make(PICKING, observation=["heightmap", {"name": "point_cloud", "points": 300}])
    env.reset(seed=0)
    hand = Pose.planar(0.45, 0.0, 0.2)
    env.scene.robot.home(hand)
    env.scene["cube"].place(Pose.planar(0.5, 0.06, 0.025, 0.3))
    points = env.observe()["point_cloud"]
    local = (points[:, :2] - (0.05, 0.06)) @ np.array(
        [[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]]
    )
    pixel = 2.0 * 1.1 * math.tan(math.radians(35.6 / 2)) / 128
    assert np.abs(local).max() < 0.025 + pixel
    assert points[:, 2].max() == pytest.approx(0.05 - 0.2, abs=pixel) and points[:, 2].min() > -0.2 - pixel
    assert len(np.unique(points, axis=0)) > 50
    env.scene["cube"].place(Pose.planar(1.5, 0.0, 0.025))
    assert not env.observe()["point_cloud"].any()


def test_a_camera_from_above_shows_what_the_heightmap_shows(make: Make) -> None:
    """Straight down, rows grow with x and columns with y."""
    above = {"name": "above", "sensor": "rgb", "position": [0.45, 0, 2], "target": [0.45, 0, 0], "size": 100}
    fov = 2 * math.degrees(math.atan(0.225 / 1.95))  # 45 cm at the height of the cube's upper side
    env = make(PICKING, observation=[{**above, "fov": fov}, "rgb"])
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.34, -0.1, 0.2))
    env.scene["cube"].place(Pose.planar(0.57, 0.09, 0.025))
    seen = env.observe()
    red, green, _ = seen["above"].astype(int)
    at = np.argwhere((red > 2.5 * green) & (red > 80))
    offset = (at.mean(axis=0) - 49.5) * 0.45 / 100
    np.testing.assert_allclose(offset, (0.12, 0.09), atol=0.45 / 100)
    assert seen["rgb"].shape == (3, 84, 84) and seen["rgb"].std() > 5


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_what_is_seen_follows_from_the_state(make: Make, env_id: str) -> None:
    env, other = make(env_id, observation=ALL), make(env_id, 1, observation=ALL)
    state = advance(env, 3, 2)
    other.reset(seed=9)
    other.set_state(state)
    assert digest(other.observe()) == digest(env.observe())
    assert transcript(env, 4) == transcript(other, 4)


@pytest.mark.parametrize("name", ["color", "segmentation"])
def test_two_cameras_do_not_tell_bodies_apart(name: str) -> None:
    with pytest.raises(ParameterError, match="view='point_cloud'"):
        make_env(PICKING, view="point_cloud", observation=["heightmap", name])


MOUNTED = {"sensor": "rgb", "mount": "wrist", "size": [64, 48]}


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_wrist_camera_moves_with_the_gripper(make: Make, env_id: str) -> None:
    depth = {"name": "depth", "mount": "wrist", "size": [64, 48]}
    env = make(env_id, observation=[{"name": "wrist", **MOUNTED}, depth, "joint_state"])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation["wrist"].shape == (3, 48, 64) and observation["depth"].shape == (1, 48, 64)
    before = env.cameras["wrist"].camera
    tcp_pose = env.scene.robot.pose
    moved = tcp_pose.compose(Pose.planar(0.03, 0.02, 0.01, 0.5))
    env.scene.robot.home(moved)
    after = env.cameras["wrist"].camera
    assert after.eye == pytest.approx(moved.transform(tcp_pose.inverse().transform(before.eye)), abs=1e-4)
    column, row = after.project(moved.transform((0.0, 0.0, -0.03)))
    assert (column, row) == pytest.approx((31.5, 23.5), abs=1e-2)
    np.testing.assert_array_equal(env.observe()["depth"][0], env.cameras["depth"].depth())


def test_joint_state_gives_the_tool_pose(make: Make) -> None:
    env = make(PICKING, observation=["joint_state"])
    env.reset(seed=0)
    observation, *_ = env.step([1.0, 0.5, 0.5, -0.5, 0.5])
    *joints, opening = observation["joint_state"]
    pose = env.scene.robot.model.chain.forward(np.array(joints, float))
    assert pose.position == pytest.approx(env.scene.robot.pose.position, abs=1e-5)
    assert opening == pytest.approx(1.0)
