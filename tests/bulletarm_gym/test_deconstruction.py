"""Finished structures to start from, and to take apart."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import digest

from bulletarm_gym.demonstrations import collect
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.deconstruction import GRASP_CLEARANCE, deconstruct
from bulletarm_gym.geometry import PlacementError
from bulletarm_gym.scene.predicates import on_surface
from bulletarm_gym.scene.sampling import footprint

Make = Callable[..., ManipulationEnv]

STACKING = "BulletArm/OpenLoopBlockStacking-v0"
HOUSE = "BulletArm/OpenLoopHouseBuilding1-v0"
GOAL = {"start": "goal"}


@pytest.fixture
def building(env: ManipulationEnv) -> ManipulationEnv:
    """The shared instance of each id whose task builds a structure."""
    if not env.task.has_goal_structure:
        pytest.skip("builds nothing")
    return env


def test_goal_starts_are_solved_and_repeatable(building: ManipulationEnv) -> None:
    for seed in range(5):
        first, info = building.reset(seed=seed, options=GOAL)
        assert info["is_success"] and info["is_valid"] and first in building.observation_space
        second, _ = building.reset(seed=seed, options=GOAL)
        assert digest(first) == digest(second)
    _, info = building.reset(seed=0)
    assert not info["is_success"]


def test_tasks_without_a_structure_refuse_and_go_on(make: Make) -> None:
    env = make("BulletArm/CloseLoopBlockPicking-v0")
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=r"BlockPicking has no arrange_goal"):
        env.reset(seed=1, options=GOAL)
    assert env.get_state() == before


@pytest.mark.parametrize("options", [{"start": "gaol"}, {"start": True}, {"begin": "goal"}], ids=str)
def test_unknown_starts_are_refused(make: Make, options: dict) -> None:
    env = make(STACKING)
    with pytest.raises(ValueError, match='"start": "goal"'):
        env.reset(options=options)


# Taking apart


def test_what_is_taken_apart_can_be_rebuilt(building: ManipulationEnv) -> None:
    """The planner's own ids; blocks go from the top, far enough apart, and all but one are moved."""
    if building.config.control != "open_loop" or not building.scene.surface.keeps_poses:
        pytest.skip("nothing here is reversed")
    demonstrations = collect(building.spec.id, 4, "deconstruction", seed=0)
    assert demonstrations.attempts <= 5
    steps = 2 * (building.config.num_objects - 1)
    assert [len(episode) for episode in demonstrations] == [steps] * 4
    holding = np.resize([0.0, 1.0], steps)
    for episode in demonstrations:
        np.testing.assert_array_equal(episode.observations["holding"][:-1, 0], holding)
        assert not episode.observations["in_hand"][::2].any()
        assert all(image.any() for image in episode.observations["in_hand"][1::2])


@pytest.mark.parametrize("env_id", [STACKING, HOUSE])
def test_blocks_go_from_the_top_to_free_ground(make: Make, env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0, options=GOAL)
    plan = deconstruct(env.scene, np.random.default_rng(0))
    heights = [waypoint.pose.z for waypoint in plan[1::2]]
    assert heights == sorted(heights) and len(heights) == 3
    for first, second in itertools.combinations(env.scene, 2):
        assert footprint(first).gap(footprint(second)) >= GRASP_CLEARANCE
        assert on_surface(env.scene, first)
    assert len({round(item.pose.yaw, 3) for item in env.scene}) == 4


def test_without_turns_nothing_turns(make: Make) -> None:
    env_kwargs = {"action_sequence": "pxy", "random_orientation": False}
    demonstrations = collect(STACKING, 3, "deconstruction", seed=0, env_kwargs=env_kwargs)
    assert demonstrations.attempts == 3
    env = make(STACKING, **env_kwargs)
    env.set_state(demonstrations[0].state)
    assert [item.pose.yaw for item in env.scene] == pytest.approx([0.0] * 4, abs=1e-4)


@pytest.mark.parametrize("robot", ["panda", "ur5", "ur5_robotiq"])
def test_every_arm_rebuilds(robot: str) -> None:
    demonstrations = collect(HOUSE, 3, "deconstruction", seed=0, env_kwargs={"robot": robot})
    assert demonstrations.attempts <= 4


def test_no_room_to_lay_a_block_is_a_failed_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise PlacementError("workspace: found no room for cube 3")

    monkeypatch.setattr("bulletarm_gym.demonstrations.collecting.deconstruct", full)
    with pytest.raises(RuntimeError, match="0 of 2 attempts"):
        collect(STACKING, 1, "deconstruction", seed=0, max_attempts=2)


def test_a_workspace_too_small_is_refused() -> None:
    small = {"workspace": [[0.4, 0.52], [-0.06, 0.06], [0.0, 1.0]]}
    with pytest.raises(PlacementError, match=r"^workspace must leave room"):
        collect(STACKING, 1, seed=0, env_kwargs=small)
