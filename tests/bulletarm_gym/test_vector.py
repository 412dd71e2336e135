"""Vector environments of Gymnasium and Stable-Baselines3: equal to single ones, members begin at states."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RescaleAction
from rollouts import TYPICAL, make_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from bulletarm_gym.vector import reset_to_states

ENV_ID = "BulletArm/CloseLoopBlockPicking-v0"
MAKE = partial(gymnasium.make, f"bulletarm_gym:{ENV_ID}", obs_size=32)


def test_members_equal_single_environments() -> None:
    vector = AsyncVectorEnv([MAKE] * 2, context="spawn")
    singles = [MAKE() for _ in range(2)]
    observations, _ = vector.reset(seed=[3, 4])
    alone = [env.reset(seed=seed)[0]["heightmap"] for env, seed in zip(singles, (3, 4), strict=True)]
    np.testing.assert_array_equal(observations["heightmap"], alone)
    for _ in range(4):
        actions = np.stack(vector.call("expert_action"))
        observations, *_ = vector.step(actions)
        alone = [env.step(action)[0]["heightmap"] for env, action in zip(singles, actions, strict=True)]
        np.testing.assert_array_equal(observations["heightmap"], alone)
    vector.close()


@pytest.mark.parametrize(("mode", "kind"), [(None, SyncVectorEnv), ("async", AsyncVectorEnv)])
def test_experts_of_wrapped_members_act_in_their_action_space(mode: str | None, kind: type) -> None:
    rescale = partial(RescaleAction, min_action=np.float32(0.0), max_action=np.float32(2.0))
    options = {"autoreset_mode": "SameStep"}
    vector: Any = gymnasium.make_vec(ENV_ID, 2, mode, options, wrappers=[rescale], obs_size=32)
    assert type(vector) is kind and vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    vector.reset(seed=3)
    solved = np.zeros(2, bool)
    for _ in range(25):
        actions = np.stack(vector.call("expert_action"))
        assert actions in vector.action_space
        solved |= vector.step(actions)[1] == 1.0
    assert solved.all()
    vector.close()


@pytest.mark.parametrize(
    ("make", "env_id"),
    [(DummyVecEnv, TYPICAL[0]), (DummyVecEnv, ENV_ID), (partial(SubprocVecEnv, start_method="fork"), ENV_ID)],
)
def test_experts_of_stable_baselines3_members_solve_the_task(make: Any, env_id: str) -> None:
    vec_env = make([partial(gymnasium.make, f"bulletarm_gym:{env_id}", obs_size=32)] * 2)
    vec_env.seed(0)
    vec_env.reset()
    solved = np.zeros(2, bool)
    for _ in range(25):
        _, _, dones, infos = vec_env.step(np.stack(vec_env.env_method("expert_action")))
        solved |= dones & np.array([info["is_success"] for info in infos])
    vec_env.close()
    assert solved.all()


@pytest.fixture(scope="module")
def starts() -> tuple[list[Any], list[Any]]:
    """Return three states, the last within an episode, and their heightmaps."""
    env = make_env(ENV_ID, obs_size=32)
    states, heightmaps = [], []
    for seed in range(3):
        env.reset(seed=40 + seed)
        if seed == 2:
            env.step(env.expert_action())
        states.append(env.get_state())
        heightmaps.append(env.observe()["heightmap"])
    env.close()
    return states, heightmaps


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_members_begin_at_states(mode: str, starts: tuple[list[Any], list[Any]]) -> None:
    states, expected = starts
    vector = gymnasium.make_vec(ENV_ID, 3, mode, obs_size=32)
    vector.reset(seed=0)
    for _ in range(2):
        observations, infos = reset_to_states(vector, states)
        np.testing.assert_array_equal(observations["heightmap"], expected)
        assert infos["is_valid"].tolist() == [True] * 3
        assert list(vector.call("get_state")) == states
        ended = False
        while (
            not ended
        ):  # afterwards Gymnasium resets some members at the next step, unless they begin at states
            *_, terminations, truncations, _ = vector.step(np.stack(vector.call("expert_action")))
            ended = bool((terminations | truncations).any())
    reset_to_states(vector, states)
    vector.step(np.zeros((3, 5), np.float32))
    assert [state.steps for state in vector.call("get_state")] == [state.steps + 1 for state in states]
    with pytest.raises(ValueError, match=r"^states must be 3 states, one per member, got 2"):
        reset_to_states(vector, states[:2])
    vector.close()


def test_states_need_shared_memory(starts: tuple[list[Any], list[Any]]) -> None:
    vector = gymnasium.make_vec(ENV_ID, 3, "async", vector_kwargs={"shared_memory": False}, obs_size=32)
    with pytest.raises(ValueError, match=r"^envs must have shared_memory=True, got shared_memory=False$"):
        reset_to_states(vector, starts[0])
    vector.close()


def test_members_of_stable_baselines3_begin_at_states(starts: tuple[list[Any], list[Any]]) -> None:
    states, expected = starts
    vector = DummyVecEnv([MAKE] * 3)
    vector.set_options([{"state": state} for state in states])
    observations: Any = vector.reset()
    np.testing.assert_array_equal(observations["heightmap"], expected)
    vector.close()
