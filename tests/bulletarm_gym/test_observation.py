"""What the close-loop agent sees: metres below a plane over the fingertips, axes of the world."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from rollouts import advance, is_open_loop, is_sloping

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose

Make = Callable[..., ManipulationEnv]

EXTENT, SIZE = 0.45, 128
RESOLUTION = EXTENT / SIZE
CAMERA_OFFSET, FINGER = 0.1, 0.021


def look(env: ManipulationEnv, hand: Pose, cube: Pose) -> np.ndarray:
    """The heightmap (SIZE, SIZE) with the open gripper and the cube put somewhere."""
    env.scene.robot.home(hand)
    env.scene["cube"].place(cube)
    return env.observe()["heightmap"][0]


def centroid(mask: np.ndarray) -> np.ndarray:
    """Mean offset (m) in x and y of the marked pixels from the middle of the image."""
    assert mask.any()
    return (np.argwhere(mask).mean(axis=0) - (len(mask) - 1) / 2) * EXTENT / len(mask)


@pytest.fixture
def scene(picking: ManipulationEnv) -> ManipulationEnv:
    picking.reset(seed=0)
    return picking


@pytest.mark.parametrize("height", [0.08, 0.11, 0.16, 0.2, 0.25])
def test_depth_is_metric_at_every_height(scene: ManipulationEnv, height: float) -> None:
    image = look(scene, Pose.planar(0.45, 0.0, height), Pose.planar(0.52, 0.06, 0.025, 0.3))
    floor = np.float32(height + CAMERA_OFFSET)
    assert image.max() == pytest.approx(floor, abs=1e-6)
    row, column = (round((SIZE - 1) / 2 + offset / RESOLUTION) for offset in (0.07, 0.06))
    assert image.max() - image[row, column] == pytest.approx(0.05, abs=1e-6)
    block = (image > 0) & (image < floor - 0.01)
    assert block.sum() * RESOLUTION**2 == pytest.approx(0.05**2, rel=0.05)


def test_depth_is_clipped_at_its_space(scene: ManipulationEnv) -> None:
    image = look(scene, Pose.planar(0.45, 0.0, 0.35), Pose.planar(0.52, 0.06, 0.025))
    assert image.max() == np.float32(0.4)


@pytest.mark.parametrize("offset", [(0.1, 0.0), (-0.08, 0.0), (0.0, 0.12), (0.09, -0.13)])
@pytest.mark.parametrize("hand", [(0.45, 0.0), (0.37, 0.08)])
def test_centred_on_the_fingertips_rows_x_columns_y(
    scene: ManipulationEnv, hand: tuple[float, float], offset: tuple[float, float]
) -> None:
    cube = Pose.planar(hand[0] + offset[0], hand[1] + offset[1], 0.025, 0.2)
    image = look(scene, Pose.planar(*hand, 0.2, math.pi / 4), cube)
    block = (image > 0) & (image < image.max() - 0.01)
    np.testing.assert_allclose(centroid(block), offset, atol=RESOLUTION / 2)


@pytest.mark.parametrize("yaw", [0.0, 0.6, math.pi / 2, -1.0])
@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_gripper_is_two_squares(scene: ManipulationEnv, yaw: float, ratio: float) -> None:
    scene.scene.robot.home(Pose.planar(0.45, 0.0, 0.2, yaw))
    scene.scene["cube"].place(Pose.planar(0.32, 0.12, 0.025))
    scene.scene.robot.set_opening(ratio)
    squares = scene.observe()["heightmap"][0] == 0.0
    axis = np.array([math.cos(yaw), math.sin(yaw)])
    along = (np.argwhere(squares) - (SIZE - 1) / 2) @ axis
    sides = [np.zeros_like(squares) for _ in range(2)]
    for side, chosen in zip(sides, (along > 0, along < 0), strict=True):
        side[tuple(np.argwhere(squares)[chosen].T)] = True
    reach = (scene.scene.robot.opening + FINGER) / 2
    np.testing.assert_allclose(centroid(sides[0]), reach * axis, atol=RESOLUTION / 2)
    np.testing.assert_allclose(centroid(sides[1]), -reach * axis, atol=RESOLUTION / 2)
    for side in sides:
        assert side.sum() * RESOLUTION**2 == pytest.approx(FINGER**2, rel=0.2)


def test_arm_is_not_drawn(scene: ManipulationEnv) -> None:
    image = look(scene, Pose.planar(0.45, 0.0, 0.06), Pose.planar(0.32, 0.12, 0.025))
    clear = np.isclose(image, image.max(), atol=1e-6)
    squares = image == 0.0
    cube = (image > 0) & ~clear
    assert (clear | squares | cube).all() and cube.sum() * RESOLUTION**2 < 1.1 * 0.05**2


def test_held_object_is_drawn_and_flagged(scene: ManipulationEnv) -> None:
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


def test_not_holding_at_first(env: ManipulationEnv) -> None:
    assert env.reset(seed=0)[0]["holding"].tolist() == [0.0]


@pytest.mark.parametrize("size", [32, 64, 129])
def test_size_changes_resolution_only(make: Make, size: int) -> None:
    env = make("BulletArm/CloseLoopBlockPicking-v0", obs_size=size)
    env.reset(seed=0)
    image = look(env, Pose.planar(0.45, 0.0, 0.2), Pose.planar(0.55, 0.05, 0.025))
    block = (image > 0) & (image < image.max() - 0.01)
    np.testing.assert_allclose(centroid(block), (0.1, 0.05), atol=EXTENT / size / 2)
    assert image.max() == pytest.approx(0.3, abs=1e-6)


def test_window_grows_with_the_workspace(make: Make) -> None:
    env = make("BulletArm/CloseLoopBlockPicking-v0", workspace=[[0.3, 0.5], [-0.1, 0.1], [0.01, 0.25]])
    env.reset(seed=0)
    image = look(env, Pose.planar(0.4, 0.0, 0.2), Pose.planar(0.5, 0.0, 0.025))
    block = (image > 0) & (image < image.max() - 0.01)
    offset = (np.argwhere(block).mean(axis=0) - 63.5) * 0.3 / SIZE
    np.testing.assert_allclose(offset, (0.1, 0.0), atol=0.002)


def quarter_turn(pose: Pose, about: Pose) -> Pose:
    """The pose turned by +90 degrees about the vertical through a point."""
    x, y = pose.x - about.x, pose.y - about.y
    turn = Pose.planar(about.x - y, about.y + x, pose.z, math.pi / 2)
    return Pose(turn.position, turn.compose(Pose((0.0, 0.0, 0.0), pose.orientation)).orientation)


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_turning_the_scene_turns_image_and_expert(env: ManipulationEnv, steps: int) -> None:
    """By +90 degrees: ``np.rot90(image, 1)`` and ``(dx, dy) -> (-dy, dx)``; p, z and r stay."""
    if is_open_loop(env.spec.id):
        pytest.skip("the picture is of the workspace; see the tests of open loop")
    if is_sloping(env.spec.id):
        pytest.skip("the ground does not turn with what lies on it")
    if steps and env.config.close_loop_tray:
        pytest.skip("the tray is the workspace's and does not turn about the hand")
    for seed in range(3):
        advance(env, seed, steps)
        hand = env.scene.robot.pose
        env.scene.robot.home(hand)
        before, action = env.observe(), env.expert_action()
        for item in list(env.scene):
            item.place(quarter_turn(item.pose, hand))
        env.scene.robot.home(quarter_turn(hand, hand))
        after, turned = env.observe(), env.expert_action()
        error = np.abs(np.rot90(before["heightmap"], 1, axes=(1, 2)) - after["heightmap"])
        assert (error > 1e-5).mean() < 1e-3, "all but pixels on an edge, whose corners are rounded"
        if steps == 0:
            p, x, y, z, r = action.tolist()
            np.testing.assert_allclose(turned[:4], [p, -y, x, z], atol=1e-4)
            # The direction of a full rotation may depend on the limits of the wrist, which do not turn.
            full_rotation = abs(turned[4]) == abs(r) == 1.0
            assert full_rotation or turned[4] == pytest.approx(r, abs=1e-4)


def test_the_turn_is_told_from_its_inverse(scene: ManipulationEnv) -> None:
    """The same comparison with the other turn fails, so the test above pins the direction."""
    hand = Pose.planar(0.45, 0.0, 0.2)
    before = look(scene, hand, Pose.planar(0.55, 0.05, 0.025, 0.3))
    after = look(scene, quarter_turn(hand, hand), quarter_turn(Pose.planar(0.55, 0.05, 0.025, 0.3), hand))
    assert (np.rot90(before, 1) != after).mean() < 1e-3
    assert (np.rot90(before, -1) != after).mean() > 1e-2
