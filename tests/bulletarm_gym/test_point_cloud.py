"""The point-cloud view: projection, holes, and agreement with the orthographic view."""

from collections.abc import Callable

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations import Window
from bulletarm_gym.observations.rasterizer import project_points

TASKS = ["Picking", "Pulling", "Pushing", "Stacking"]
VIEWS = ("orthographic", "point_cloud")


def test_highest_point_of_a_pixel_counts() -> None:
    points = np.array([[0.1, 0.1, 0.02], [0.1, 0.1, 0.05], [0.3, 0.1, 0.01], [0.1, 0.1, 0.5]])
    image = project_points(points, Window((0.2, 0.2), 0.4, 2), ceiling=0.3)
    assert image[0, 0] == np.float32(0.05), "the point above the ceiling is left out"
    assert image[1, 0] == np.float32(0.01), "rows grow with x"


def test_hole_takes_its_nearest_neighbour() -> None:
    points = np.array([[0.05, 0.05, 0.01], [0.95, 0.95, 0.02]])
    image = project_points(points, Window((0.5, 0.5), 1.0, 10), ceiling=1.0)
    assert image[3, 3] == np.float32(0.01)
    assert image[7, 7] == np.float32(0.02)
    assert image[0, 9] == image[9, 0] == np.float32(0.01), "of two equally near the first"


def test_nothing_seen_is_the_floor() -> None:
    assert not project_points(np.empty((0, 3)), Window((0.0, 0.0), 1.0, 4), ceiling=1.0).any()


@pytest.mark.parametrize("task", TASKS)
def test_agrees_with_the_orthographic_view(task: str, make: Callable[..., ManipulationEnv]) -> None:
    """Within a millimetre but at edges, and where the arm hides something from both cameras."""
    env_id = f"BulletArm/CloseLoopBlock{task}-v0"
    first, second = (make(env_id, view=view) for view in VIEWS)
    for seed in range(2):
        seen, _ = first.reset(seed=seed)
        clouded, _ = second.reset(seed=seed)
        for _ in range(3):
            difference = np.abs(seen["heightmap"] - clouded["heightmap"])
            assert np.median(difference) < 1e-5
            assert (difference > 5e-3).mean() < 0.03
            action = first.expert_action()
            seen, clouded = first.step(action)[0], second.step(action)[0]


def test_cloud_shows_no_arm(make: Callable[..., ManipulationEnv]) -> None:
    """The gripper stands over an empty floor: but for its two squares nothing is nearer than the floor."""
    env = make("BulletArm/CloseLoopBlockPicking-v0", view="point_cloud")
    env.reset(seed=0)
    env.scene["cube"].park()
    image = env.observe()["heightmap"]
    floor = env.scene.robot.pose.z + 0.1
    assert (image[image > 0.0] > floor - 2e-3).all()
