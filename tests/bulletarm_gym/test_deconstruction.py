"""Episodes that start with a finished structure, and the planner that takes it apart."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import digest

from bulletarm_gym.demonstrations import collect
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.pick_place import GRASP_CLEARANCE, deconstruct
from bulletarm_gym.scene.predicates import on_surface
from bulletarm_gym.scene.sampling import footprint

Make = Callable[..., ManipulationEnv]

STACKING = "BulletArm/OpenLoopBlockStacking-v0"
HOUSE = "BulletArm/OpenLoopHouseBuilding1-v0"
IMPROVISE = "BulletArm/OpenLoopImproviseHouseBuilding3-v0"
GOAL = {"start": "goal"}


@pytest.mark.parametrize(
    "env_id",
    [
        STACKING,
        HOUSE,
        IMPROVISE,
        "BulletArm/OpenLoopRampHouseBuilding4-v0",
        "BulletArm/CloseLoopHouseBuilding-v0",
    ],
)
def test_goal_starts_are_solved_and_repeatable(make: Make, env_id: str) -> None:
    env = make(env_id)
    for seed in range(3):
        first, info = env.reset(seed=seed, options=GOAL)
        assert info["is_success"] and info["is_valid"] and first in env.observation_space
        assert digest(first) == digest(env.reset(seed=seed, options=GOAL)[0])
    assert not env.reset(seed=0)[1]["is_success"]


def test_goal_start_needs_a_structure(picking: ManipulationEnv) -> None:
    picking.reset(seed=0)
    before = picking.get_state()
    with pytest.raises(ValueError, match="BlockPicking has no arrange_goal"):
        picking.reset(seed=1, options=GOAL)
    assert picking.get_state() == before


@pytest.mark.parametrize("options", [{"start": "gaol"}, {"start": True}, {"begin": "goal"}], ids=str)
def test_unknown_starts_are_rejected(make: Make, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match='"start": "goal"'):
        make(STACKING).reset(options=options)


@pytest.mark.parametrize(
    ("env_id", "env_kwargs"),
    [
        (STACKING, {"action_sequence": "pxy", "random_orientation": False}),
        (IMPROVISE, {}),
        *((HOUSE, {"robot": robot}) for robot in ("kuka", "panda", "ur5", "ur5_robotiq")),
    ],
    ids=str,
)
def test_demonstrations_rebuild_the_structure(make: Make, env_id: str, env_kwargs: dict[str, Any]) -> None:
    demonstrations = collect(env_id, 3, "deconstruction", seed=0, env_kwargs=env_kwargs)
    assert demonstrations.attempts <= 4
    env = make(env_id, **env_kwargs)
    steps = 2 * (env.config.num_objects - 1)
    for episode in demonstrations:
        np.testing.assert_array_equal(episode.observations["holding"][:-1, 0], np.resize([0.0, 1.0], steps))
        assert not episode.observations["in_hand"][::2].any()
        assert all(image.any() for image in episode.observations["in_hand"][1::2])
    env.set_state(demonstrations[0].state)
    if "random_orientation" in env_kwargs:
        assert [obj.pose.yaw for obj in env.scene] == pytest.approx([0.0] * 4, abs=1e-4)


def test_blocks_are_moved_from_the_top_to_the_free_surface(make: Make) -> None:
    env = make(HOUSE)
    env.reset(seed=0, options=GOAL)
    plan = deconstruct(env.scene, np.random.default_rng(0))
    heights = [waypoint.pose.z for waypoint in plan[1::2]]
    assert heights == sorted(heights) and len(heights) == 3
    for first, second in itertools.combinations(env.scene, 2):
        assert footprint(first).gap(footprint(second)) >= GRASP_CLEARANCE
        assert on_surface(env.scene, first)
