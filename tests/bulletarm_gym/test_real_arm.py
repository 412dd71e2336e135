"""Observations and heights from point clouds equal those of the environments."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.observations.cameras import SIDE_PIXELS, side_cameras
from bulletarm_gym.real_arm import (
    close_loop_heightmap,
    in_hand_image,
    measure_grasp,
    open_loop_heightmap,
    pick_height,
    place_height,
)

Make = Callable[..., ManipulationEnv]


def cloud(env: ManipulationEnv, shows_grasped: bool) -> FloatArray:
    """Return the points of two depth cameras next to the workspace, without the arm."""
    robot = env.scene.robot
    absent = [robot.body] if shows_grasped or robot.held is None else [robot.body, robot.held]
    cameras = side_cameras(env.scene.config, SIDE_PIXELS)
    return np.concatenate([camera.points(env.scene.world, absent) for camera in cameras])


@pytest.mark.parametrize(
    "env_kwargs", [{}, {"obs_size": 64, "workspace": [[0.32, 0.6], [-0.1, 0.18], [0.02, 0.2]]}]
)
def test_close_loop_heightmap_equals_the_point_cloud_view(env_kwargs: dict[str, Any], make: Make) -> None:
    env = make("BulletArm/CloseLoopBlockStacking-v0", view="point_cloud", **env_kwargs)
    observation, _ = env.reset(seed=1)
    for _ in range(5):
        robot, config = env.scene.robot, env.config
        image = close_loop_heightmap(
            cloud(env, shows_grasped=True), robot.pose, robot.opening, config.workspace, config.obs_size
        )
        assert (image == observation["heightmap"]).all() and image.dtype == np.float32
        observation, *_ = env.step(env.expert_action())
    assert env.scene.held is not None


def test_open_loop_heightmap_differs_from_the_orthographic_view_at_edges_only(make: Make) -> None:
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(env.expert_action())
        difference = np.abs(open_loop_heightmap(cloud(env, shows_grasped=False)) - observation["heightmap"])
        assert np.median(difference) < 1e-5 and (difference > 1e-3).mean() < 0.03


@pytest.mark.parametrize("name", ["BlockStacking", "RampBlockStacking"])
def test_in_hand_image_equals_that_of_the_environment(name: str, make: Make) -> None:
    env = make(f"BulletArm/OpenLoop{name}-v0")
    before, _ = env.reset(seed=0)
    action = env.expert_action()
    move = env.decode_action(action)
    after, *_ = env.step(action)
    image = in_hand_image(before["heightmap"], move.pose, tilts=name.startswith("Ramp"))
    assert image.any() and (image == after["in_hand"]).all()


@pytest.mark.parametrize("floor", [0.0, 0.01])
def test_heights_of_picks_and_places_equal_those_of_the_environment(floor: float, make: Make) -> None:
    workspace = [[0.25, 0.65], [-0.2, 0.2], [floor, 1.0]]
    env = make("BulletArm/OpenLoopHouseBuilding1-v0", workspace=workspace)
    params = env.task.grasp_params
    before, _ = env.reset(seed=0)
    for _ in range(3):
        action = env.expert_action()
        tool = env.control.executed(env.decode_action(action))
        height = pick_height(before["heightmap"], tool, params.pick_offset, workspace=workspace)
        assert height == pytest.approx(tool.z)
        after, *_ = env.step(action)
        grasp = measure_grasp(before["heightmap"], after["heightmap"], tool, workspace)
        assert grasp is not None and tuple(grasp) == pytest.approx(env.control.memory, abs=1e-4)
        action = env.expert_action()
        tool = env.control.executed(env.decode_action(action))
        height = place_height(after["heightmap"], tool, grasp, params.place_offset, workspace)
        assert height == pytest.approx(tool.z, abs=1e-4)
        before, *_ = env.step(action)


def test_points_must_be_world_coordinates_in_the_square() -> None:
    tool = Pose((0.45, 0.0, 0.2))
    with pytest.raises(ValueError, match=r"points .*\(3,\)"):
        close_loop_heightmap([0.4, 0.0, 0.0], tool, 0.05)
    with pytest.raises(ValueError, match=r"points .*0\.45 m"):
        close_loop_heightmap([[450.0, 0.0, 0.0]], tool, 0.05)
    with pytest.raises(ValueError, match=r"points .*0\.4 m"):
        open_loop_heightmap([[np.nan, 0.0, 0.0]])


def test_points_that_are_not_finite_are_ignored() -> None:
    known = [[0.45, 0.0, 0.03], [0.5, 0.1, 0.0]]
    unknown = [[np.nan] * 3, [0.45, 0.0, np.inf]]
    assert (open_loop_heightmap(known + unknown) == open_loop_heightmap(known)).all()
