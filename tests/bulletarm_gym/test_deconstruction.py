"""Finished structures to start from."""

from collections.abc import Callable

import pytest
from rollouts import digest

from bulletarm_gym.env import ManipulationEnv

Make = Callable[..., ManipulationEnv]

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
    with pytest.raises(ValueError, match="BlockPicking builds no structure"):
        env.reset(seed=1, options=GOAL)
    assert env.get_state() == before


@pytest.mark.parametrize("options", [{"start": "gaol"}, {"start": True}, {"begin": "goal"}], ids=str)
def test_unknown_starts_are_refused(make: Make, options: dict) -> None:
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    with pytest.raises(ValueError, match='"start": "goal"'):
        env.reset(options=options)
