"""From a point cloud to what the environments observe."""

from collections.abc import Callable

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import FloatArray, Pose, euler_pose
from bulletarm_gym.observations.cameras import SIDE_PIXELS, side_cameras
from bulletarm_gym.real_arm import (
    close_loop_heightmap,
    in_hand_image,
    measure_grasp,
    open_loop_heightmap,
    pick_height,
    place_height,
)

STACKING = "BulletArm/CloseLoopBlockStacking-v0"
MILLIMETRE = 1e-3


def cloud(env: ManipulationEnv, held: bool) -> FloatArray:
    """Points as two depth cameras beside the workspace see them, without the arm."""
    scene = env.scene
    absent = [scene.robot.body, *([] if held or scene.robot.held is None else [scene.robot.held])]
    cameras = side_cameras(scene.config, SIDE_PIXELS)
    return np.concatenate([camera.points(scene.world, absent) for camera in cameras])


@pytest.mark.parametrize(
    "env_kwargs", [{}, {"obs_size": 64, "workspace": [[0.32, 0.6], [-0.1, 0.18], [0.02, 0.2]]}]
)
def test_close_loop_is_the_point_cloud_view_exactly(
    env_kwargs: dict[str, object], make: Callable[..., ManipulationEnv]
) -> None:
    """On the way to a block, and with the block in the hand."""
    env = make(STACKING, view="point_cloud", **env_kwargs)
    observation, _ = env.reset(seed=1)
    for _ in range(6):
        robot, config = env.scene.robot, env.config
        mine = close_loop_heightmap(
            cloud(env, held=True), robot.pose, robot.opening, config.workspace, config.obs_size
        )
        assert (mine == observation["heightmap"]).all()
        assert mine.dtype == np.float32
        observation, *_ = env.step(env.expert_action())
    assert env.scene.held is not None


def test_open_loop_is_the_orthographic_view_but_at_edges(make: Callable[..., ManipulationEnv]) -> None:
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(env.expert_action())
        difference = np.abs(open_loop_heightmap(cloud(env, held=False)) - observation["heightmap"])
        assert np.median(difference) < 0.01 * MILLIMETRE
        assert (difference > MILLIMETRE).mean() < 0.03


@pytest.mark.parametrize(
    ("env_id", "tilts"),
    [("BulletArm/OpenLoopBlockStacking-v0", False), ("BulletArm/OpenLoopRampBlockStacking-v0", True)],
)
def test_the_in_hand_image_is_the_environments(
    env_id: str, tilts: bool, make: Callable[..., ManipulationEnv]
) -> None:
    env = make(env_id)
    before, _ = env.reset(seed=0)
    action = env.expert_action()
    move = env.decode_action(action)
    theta, phi, psi = move.rotation
    after, *_ = env.step(action)
    assert after["in_hand"].any()
    pick = euler_pose(move.position, (psi, phi, theta))
    assert (in_hand_image(before["heightmap"], pick, tilts=tilts) == after["in_hand"]).all()


@pytest.mark.parametrize("floor", [0.0, 0.01])
def test_heights_of_picks_and_places_are_the_environments(
    floor: float, make: Callable[..., ManipulationEnv]
) -> None:
    workspace = [[0.25, 0.65], [-0.2, 0.2], [floor, 1.0]]
    env = make("BulletArm/OpenLoopHouseBuilding1-v0", workspace=workspace)
    before, _ = env.reset(seed=0)
    for _ in range(3):
        action = env.expert_action()
        hand = env.control.executed(env.decode_action(action))
        assert pick_height(
            before["heightmap"], hand, env.task.grasp_params.pick_offset, workspace=workspace
        ) == pytest.approx(hand.z)
        after, *_ = env.step(action)
        grasp = measure_grasp(before["heightmap"], after["heightmap"], hand, workspace)
        assert grasp is not None and tuple(grasp) == pytest.approx(env.control.memory, abs=1e-4)
        action = env.expert_action()
        hand = env.control.executed(env.decode_action(action))
        height = place_height(after["heightmap"], hand, grasp, env.task.grasp_params.place_offset, workspace)
        assert height == pytest.approx(hand.z, abs=1e-4)
        before, *_ = env.step(action)


def test_what_no_point_cloud_of_the_cell_is_is_refused() -> None:
    hand = Pose((0.45, 0.0, 0.2))
    with pytest.raises(ValueError, match=r"points must be .*\(n, 3\), got \(3,\)"):
        close_loop_heightmap([0.4, 0.0, 0.0], hand, 0.05)
    with pytest.raises(ValueError, match=r"points must be .* square of 0\.45 m.*, got 1"):
        close_loop_heightmap([[450.0, 0.0, 0.0]], hand, 0.05)
    with pytest.raises(ValueError, match=r"points must be .* square of 0\.4 m.*, got 0"):
        open_loop_heightmap([[np.nan, 0.0, 0.0]])


def test_points_that_a_camera_does_not_know_are_left_out() -> None:
    known = [[0.45, 0.0, 0.03], [0.5, 0.1, 0.0]]
    unknown = [[np.nan] * 3, [0.45, 0.0, np.inf]]
    assert (open_loop_heightmap(known + unknown) == open_loop_heightmap(known)).all()
