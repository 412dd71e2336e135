"""Heights of picks and places whose action has no z follow from heightmaps alone."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.control import Grasp, PickPlace
from bulletarm_gym.control.heights import measure_grasp, pick_height, place_height
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, Rectangle
from bulletarm_gym.observations import ElevationMap

Make = Callable[..., ManipulationEnv]
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
HOUSE = "BulletArm/OpenLoopHouseBuilding1-v0"
CUBE = 0.03
PIXEL = 0.4 / 128
CENTRE = (0.45, 0.0)


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    env = make(STACKING)
    env.reset(seed=0)
    return env


def lay_out(env: ManipulationEnv, *poses: Pose) -> None:
    """Put the cubes at poses, and those without a pose aside, one on another."""
    env.reset(seed=0)
    aside = [Pose((0.28, -0.17, CUBE * (0.5 + k))) for k in range(4)]
    for item, pose in zip(env.scene, [*poses, *aside], strict=False):
        item.place(pose)


def height_at(env: ManipulationEnv, primitive: str, x: float, y: float) -> float:
    """Return the decoded height (m) of a pick or place without z."""
    return float(env.decode_action(env.encode_action(PickPlace(primitive, (x, y, 0.0)))).position[2])


def pick(env: ManipulationEnv, x: float, y: float) -> Any:
    env.step(env.encode_action(PickPlace("pick", (x, y, 0.0))))
    assert env.scene.held is not None
    return env.scene.held


def square(height: float, middle: tuple[float, float], side: float, ground: float = 0.0) -> ElevationMap:
    """Return the heightmap of a square on level ground."""
    axis = (np.arange(128) + 0.5) * PIXEL - 0.2
    inside = [np.abs(axis + offset - at) <= side / 2.0 for offset, at in zip(CENTRE, middle, strict=True)]
    heights = np.where(np.outer(*inside), height, ground).astype(np.float32)
    return ElevationMap(heights, CENTRE, 0.4)


# Picks


def test_pick_goes_half_a_cube_below_what_is_between_the_fingers(env: ManipulationEnv) -> None:
    lay_out(
        env,
        Pose.planar(0.5, 0.1, CUBE / 2),
        Pose.planar(0.4, -0.1, CUBE / 2),
        Pose.planar(0.4, -0.1, 1.5 * CUBE),
    )
    assert height_at(env, "pick", 0.5, 0.1) == pytest.approx(CUBE / 2, abs=1e-3)
    assert height_at(env, "pick", 0.4, -0.1) == pytest.approx(1.5 * CUBE, abs=1e-3)
    assert height_at(env, "pick", 0.5, -0.1) == height_at(env, "pick", 0.65, 0.2) == pytest.approx(0.005)
    area = Rectangle(0.5, 0.1, CUBE, CUBE, 0.0)
    assert pick_height(env.look().elevation_map, area, 0.02) == pytest.approx(CUBE - 0.02)


@pytest.mark.parametrize("size", [16, 24, 40])
def test_height_does_not_depend_on_the_size_of_the_in_hand_image(make: Make, size: int) -> None:
    env, plain = make(STACKING, in_hand_size=size), make(STACKING)
    for each in (env, plain):
        each.reset(seed=2)
        each.step(each.expert_action())
    action = env.expert_action()
    assert env.decode_action(action) == plain.decode_action(action)


# Places


def test_place_clears_the_highest_point_under_the_grasped_object(make: Make) -> None:
    env = make(HOUSE)
    env.reset(seed=0)
    roof = env.scene["triangle"]
    for number, item in enumerate(env.scene):
        item.place(Pose.planar(0.3, 0.1 - 0.09 * number, CUBE / 2))
    roof.place(Pose.planar(0.55, 0.0, CUBE / 2, 0.0))
    assert pick(env, 0.55, 0.0) is roof
    level = env.scene.robot.pose.z - roof.lowest + env.task.grasp_params.place_offset
    points = ((0.5, 0.0), (0.3, 0.1), (0.3 + CUBE / 2 + 0.009, 0.1), (0.3 + CUBE + 0.006, 0.1))
    heights = [height_at(env, "place", x, y) for x, y in points]
    assert heights == pytest.approx([level, level + CUBE, level + CUBE, level], abs=1e-3)


def test_place_knows_the_height_of_an_object_from_a_stack(env: ManipulationEnv) -> None:
    """The surface under the upper cube is seen after the pick."""
    lay_out(env, Pose.planar(0.4, -0.1, CUBE / 2), Pose.planar(0.4, -0.1, 1.5 * CUBE))
    pick(env, 0.4, -0.1)
    level = CUBE / 2 + env.task.grasp_params.place_offset
    assert height_at(env, "place", 0.5, 0.1) == pytest.approx(level, abs=1.5e-3)
    assert height_at(env, "place", 0.4, -0.1) == pytest.approx(level + CUBE, abs=1.5e-3)


def test_place_height_does_not_use_the_simulated_object(env: ManipulationEnv) -> None:
    """A grasped object that is moved or exchanged in the simulation changes nothing."""
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    held = pick(env, 0.5, 0.1)
    before = height_at(env, "place", 0.4, 0.0)
    held.place(Pose((0.7, 0.3, 0.9), (0.6, 0.0, 0.0, 0.8)))
    assert height_at(env, "place", 0.4, 0.0) == before
    env.scene.robot.held = env.scene["cube 1"].body
    assert height_at(env, "place", 0.4, 0.0) == before


def test_object_without_measurements_counts_as_a_cube(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    pick(env, 0.5, 0.1)
    env.control.memory = None
    level = env.task.grasp_params.pick_offset + env.task.grasp_params.place_offset
    assert height_at(env, "place", 0.4, 0.0) == pytest.approx(level)


def test_measurements_last_until_the_gripper_is_empty(env: ManipulationEnv) -> None:
    lay_out(env, Pose.planar(0.5, 0.1, CUBE / 2))
    env.step(env.encode_action(PickPlace("pick", (0.4, 0.0, 0.0))))
    assert env.control.memory is None, "nothing was grasped"
    pick(env, 0.5, 0.1)
    known = env.control.memory
    *_, info = env.step(env.encode_action(PickPlace("pick", (0.4, 0.0, 0.0))))
    assert info["ignored"] and env.control.memory == known
    env.step(env.encode_action(PickPlace("place", (0.4, 0.0, 0.0))))
    assert env.scene.held is None and env.control.memory is None


# Measurements


@pytest.mark.parametrize("yaw", [0.0, 0.6, -2.5])
@pytest.mark.parametrize("ground", [0.0, 0.05])
def test_grasp_is_measured_where_the_pick_lowered_the_heightmap(yaw: float, ground: float) -> None:
    """Another object that moved at the same time does not count."""
    before, after = (square(height, (0.5, 0.05), 0.04, ground) for height in (ground + 0.03, ground))
    before.heights[10:20, 10:20] = 0.1
    grasp = measure_grasp(before, after, Pose.planar(0.51, 0.05, ground + 0.02, yaw))
    assert grasp is not None
    assert grasp.height == pytest.approx(0.02, abs=1e-6)
    middle = Pose.planar(0.51, 0.05, 0.0, yaw).transform((grasp.x, grasp.y, 0.0))
    assert middle[:2] == pytest.approx((0.5, 0.05), abs=PIXEL)
    side = 0.04 * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
    assert side - 3 * PIXEL < grasp.length < side and side - 3 * PIXEL < grasp.width < side


def test_grasp_is_not_measured_without_a_change_near_the_fingers() -> None:
    before, after = square(0.03, (0.5, 0.05), 0.04), square(0.0, (0.5, 0.05), 0.04)
    assert measure_grasp(before, before, Pose.planar(0.5, 0.05, 0.02)) is None
    assert measure_grasp(before, after, Pose.planar(0.35, -0.1, 0.02)) is None


def test_footprint_turns_with_the_target() -> None:
    heights = square(0.03, (0.5, 0.0), 0.04)
    grasp = Grasp(0.02, 0.0, 0.0, 0.01, 0.08)
    beside = Pose.planar(0.5, 0.05, 0.0)
    assert place_height(heights, beside, grasp, 0.003) == pytest.approx(0.053)
    turned = Pose.planar(0.5, 0.05, 0.0, np.pi / 2)
    assert place_height(heights, turned, grasp, 0.003) == pytest.approx(0.023)
