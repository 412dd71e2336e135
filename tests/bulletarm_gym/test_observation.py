"""Heightmaps of close-loop control: metres below a plane above the fingertips, axes of the world."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from rollouts import advance

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations import Window
from bulletarm_gym.observations.rasterizer import project_points

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
EXTENT, SIZE = 0.45, 128
RESOLUTION = EXTENT / SIZE
CAMERA_OFFSET, FINGER = 0.1, 0.021


def look(env: ManipulationEnv, hand: Pose, cube: Pose) -> np.ndarray:
    """Return the heightmap with the open gripper and the cube at poses."""
    env.scene.robot.home(hand)
    env.scene["cube"].place(cube)
    return env.observe()["heightmap"][0]


def raised(image: np.ndarray) -> np.ndarray:
    """Return the mask of pixels above the floor."""
    return (image > 0) & (image < image.max() - 0.01)


def centroid(mask: np.ndarray, extent: float = EXTENT) -> np.ndarray:
    """Return the mean offset (m) in x and y of the masked pixels from the centre of the image."""
    assert mask.any()
    return (np.argwhere(mask).mean(axis=0) - (len(mask) - 1) / 2) * extent / len(mask)


@pytest.fixture
def scene(picking: ManipulationEnv) -> ManipulationEnv:
    picking.reset(seed=0)
    return picking


@pytest.mark.parametrize("height", [0.08, 0.16, 0.25, 0.35])
def test_depth_is_metric_and_clipped(scene: ManipulationEnv, height: float) -> None:
    image = look(scene, Pose.planar(0.45, 0.0, height), Pose.planar(0.52, 0.06, 0.025, 0.3))
    assert image.max() == pytest.approx(min(height + CAMERA_OFFSET, 0.4), abs=1e-6)
    row, column = (round((SIZE - 1) / 2 + offset / RESOLUTION) for offset in (0.07, 0.06))
    assert image[row, column] == pytest.approx(min(height + CAMERA_OFFSET - 0.05, 0.4), abs=1e-6)
    if height < 0.3:
        assert raised(image).sum() * RESOLUTION**2 == pytest.approx(0.05**2, rel=0.05)


@pytest.mark.parametrize("offset", [(0.1, 0.0), (-0.08, 0.0), (0.0, 0.12), (0.09, -0.13)])
def test_image_is_centred_on_the_fingertips(scene: ManipulationEnv, offset: tuple[float, float]) -> None:
    """Rows grow with x, columns with y."""
    for hand in ((0.45, 0.0), (0.37, 0.08)):
        cube = Pose.planar(hand[0] + offset[0], hand[1] + offset[1], 0.025, 0.2)
        image = look(scene, Pose.planar(*hand, 0.2, math.pi / 4), cube)
        np.testing.assert_allclose(centroid(raised(image)), offset, atol=RESOLUTION / 2)


@pytest.mark.parametrize("yaw", [0.0, 0.6, -1.0])
@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_gripper_is_two_squares(scene: ManipulationEnv, yaw: float, ratio: float) -> None:
    """The arm and the rest of the gripper are not rendered."""
    scene.scene.robot.home(Pose.planar(0.45, 0.0, 0.06, yaw))
    scene.scene["cube"].park()
    scene.scene.robot.set_opening(ratio)
    image = scene.observe()["heightmap"][0]
    squares = image == 0.0
    assert np.isclose(image[~squares], image.max(), atol=1e-6).all()
    axis = np.array([math.cos(yaw), math.sin(yaw)])
    along = np.zeros(image.shape)
    along[squares] = (np.argwhere(squares) - (SIZE - 1) / 2) @ axis
    reach = (scene.scene.robot.opening + FINGER) / 2
    for side, sign in ((along > 0, 1.0), (along < 0, -1.0)):
        np.testing.assert_allclose(centroid(side), sign * reach * axis, atol=RESOLUTION / 2)
        assert side.sum() * RESOLUTION**2 == pytest.approx(FINGER**2, rel=0.2)


def test_grasped_object_is_visible(scene: ManipulationEnv) -> None:
    scene.reset(seed=3)
    for _ in range(8):
        observation, *_ = scene.step(scene.expert_action())
        if observation["holding"][0] == 1.0:
            break
    assert scene.scene.held is scene.scene["cube"]
    observation, *_ = scene.step([-1.0, 0.0, 0.0, 1.0, 0.0])
    assert observation["holding"].tolist() == [1.0]
    hand, cube = scene.scene.robot.pose, scene.scene["cube"].pose
    middle = observation["heightmap"][0, SIZE // 2, SIZE // 2]
    assert middle == pytest.approx(hand.z + CAMERA_OFFSET - (cube.z + 0.025), abs=2e-3)


@pytest.mark.parametrize("size", [32, 129])
def test_size_changes_the_resolution_only(make: Make, size: int) -> None:
    env = make(PICKING, obs_size=size)
    env.reset(seed=0)
    image = look(env, Pose.planar(0.45, 0.0, 0.2), Pose.planar(0.55, 0.05, 0.025))
    assert image.shape == (size, size) and image.max() == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(centroid(raised(image)), (0.1, 0.05), atol=EXTENT / size / 2)


def test_square_grows_with_the_workspace(make: Make) -> None:
    env = make(PICKING, workspace=[[0.3, 0.5], [-0.1, 0.1], [0.01, 0.25]])
    env.reset(seed=0)
    image = look(env, Pose.planar(0.4, 0.0, 0.2), Pose.planar(0.5, 0.0, 0.025))
    np.testing.assert_allclose(centroid(raised(image), 0.3), (0.1, 0.0), atol=0.002)


# Rotations


def quarter_turn(pose: Pose, about: Pose) -> Pose:
    """Return the pose rotated by +90 degrees about the vertical through a point."""
    x, y = pose.x - about.x, pose.y - about.y
    turn = Pose.planar(about.x - y, about.y + x, pose.z, math.pi / 2)
    return Pose(turn.position, turn.compose(Pose((0.0, 0.0, 0.0), pose.orientation)).orientation)


@pytest.mark.parametrize("steps", [0, 2])
@pytest.mark.parametrize("name", ["BlockPicking", "BlockPushing", "BlockStacking", "ObjectGrasping"])
def test_rotated_scene_gives_rotated_image_and_action(make: Make, name: str, steps: int) -> None:
    """By +90 degrees: ``np.rot90(image, 1)`` and ``(dx, dy) -> (-dy, dx)``; p, z and r stay."""
    env = make(f"BulletArm/CloseLoop{name}-v0")
    if steps and env.config.close_loop_tray:
        pytest.skip("the tray does not rotate about the hand")
    for seed in range(2):
        advance(env, seed, steps)
        hand = env.scene.robot.pose
        env.scene.robot.home(hand)
        before, action = env.observe()["heightmap"], env.expert_action()
        for item in list(env.scene):
            item.place(quarter_turn(item.pose, hand))
        env.scene.robot.home(quarter_turn(hand, hand))
        after, rotated = env.observe()["heightmap"], env.expert_action()
        error = np.abs(np.rot90(before, 1, axes=(1, 2)) - after)
        assert (error > 1e-5).mean() < 1e-3, "all but pixels on an edge, whose corners are rounded"
        if steps == 0:
            assert (np.abs(np.rot90(before, -1, axes=(1, 2)) - after) > 1e-5).mean() > 5e-3
            p, x, y, z, r = action.tolist()
            np.testing.assert_allclose(rotated[:4], [p, -y, x, z], atol=1e-4)
            # The direction of a full rotation may depend on the limits of the wrist, which do not rotate.
            assert abs(rotated[4]) == abs(r) == 1.0 or rotated[4] == pytest.approx(r, abs=1e-4)


# The view "point_cloud"


def test_highest_point_of_a_pixel_counts() -> None:
    points = np.array([[0.1, 0.1, 0.02], [0.1, 0.1, 0.05], [0.3, 0.1, 0.01], [0.1, 0.1, 0.5]])
    image = project_points(points, Window((0.2, 0.2), 0.4, 2), ceiling=0.3)
    assert image[:, 0].tolist() == [np.float32(0.05), np.float32(0.01)]
    assert image.flags.c_contiguous


def test_hole_gets_the_value_of_the_nearest_pixel() -> None:
    points = np.array([[0.05, 0.05, 0.01], [0.95, 0.95, 0.02]])
    image = project_points(points, Window((0.5, 0.5), 1.0, 10), ceiling=1.0)
    assert image[3, 3] == np.float32(0.01) and image[7, 7] == np.float32(0.02)
    assert not project_points(np.empty((0, 3)), Window((0.0, 0.0), 1.0, 4), ceiling=1.0).any()


@pytest.mark.parametrize("name", ["BlockPicking", "BlockPushing"])
def test_point_cloud_view_agrees_with_the_orthographic_view(make: Make, name: str) -> None:
    """Within a millimetre except at edges, and where the arm hides something from both cameras."""
    env_id = f"BulletArm/CloseLoop{name}-v0"
    first, second = (make(env_id, view=view) for view in ("orthographic", "point_cloud"))
    seen, clouded = (each.reset(seed=0)[0] for each in (first, second))
    for _ in range(3):
        difference = np.abs(seen["heightmap"] - clouded["heightmap"])
        assert np.median(difference) < 1e-5 and (difference > 5e-3).mean() < 0.03
        action = first.expert_action()
        seen, clouded = first.step(action)[0], second.step(action)[0]


def test_point_cloud_view_shows_the_floor_and_not_the_arm(make: Make) -> None:
    env = make(PICKING, view="point_cloud")
    env.reset(seed=0)
    env.scene["cube"].park()
    image = env.observe()["heightmap"]
    assert np.abs(image[image > 0.0] - (env.scene.robot.pose.z + CAMERA_OFFSET)).max() < 2e-5
