"""Vector environments equal single ones, and their members begin at states."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, RescaleAction
from stable_baselines3.common.vec_env import DummyVecEnv

import bulletarm_gym
from bulletarm_gym.vector import reset_to_states

ENV_ID = "BulletArm/CloseLoopBlockPicking-v0"


@pytest.mark.parametrize("context", ["fork", "forkserver", "spawn"])
def test_equals_single_environments(context: str) -> None:
    make = partial(gymnasium.make, f"bulletarm_gym:{ENV_ID}", obs_size=32)
    vector = AsyncVectorEnv([make] * 2, context=context)
    singles = [gymnasium.make(ENV_ID, obs_size=32) for _ in range(2)]
    observations, _ = vector.reset(seed=[3, 4])
    for number, env in enumerate(singles):
        np.testing.assert_array_equal(
            observations["heightmap"][number], env.reset(seed=3 + number)[0]["heightmap"]
        )
    for _ in range(5):
        actions = np.stack(vector.call("expert_action"))
        observations, *_ = vector.step(actions)
        for number, env in enumerate(singles):
            expected = env.step(actions[number])[0]["heightmap"]
            np.testing.assert_array_equal(observations["heightmap"][number], expected)
    vector.close()


@pytest.mark.parametrize("env_id", bulletarm_gym.ENV_IDS)
def test_make_vec_of_every_id(env_id: str) -> None:
    vector = gymnasium.make_vec(env_id, num_envs=2, obs_size=32)
    observations, _ = vector.reset(seed=0)
    assert observations in vector.observation_space
    vector.close()


@pytest.mark.parametrize(
    ("mode", "kind"), [(None, SyncVectorEnv), ("sync", SyncVectorEnv), ("async", AsyncVectorEnv)]
)
def test_make_vec_takes_what_gymnasium_says(mode: str | None, kind: type) -> None:
    vector = gymnasium.make_vec(
        ENV_ID,
        num_envs=2,
        vectorization_mode=mode,
        vector_kwargs={"autoreset_mode": "SameStep"},
        wrappers=[FlattenObservation],
        obs_size=16,
    )
    assert type(vector) is kind and vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observations, _ = vector.reset(seed=0)
    assert observations.shape == (2, 16 * 16 + 1)
    vector.close()


def make_vector(mode: str, **options: Any) -> Any:
    return gymnasium.make_vec(ENV_ID, 3, mode, vector_kwargs=options, obs_size=32)


def states_and_observations() -> tuple[list[Any], list[Any]]:
    """Return three states, the last within an episode, and their observations."""
    env: Any = gymnasium.make(ENV_ID, obs_size=32).unwrapped
    states, observations = [], []
    for seed in range(3):
        observation, _ = env.reset(seed=40 + seed)
        if seed == 2:
            observation, *_ = env.step(env.expert_action())
        states.append(env.get_state())
        observations.append(observation["heightmap"])
    env.close()
    return states, observations


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_members_begin_at_states_of_their_own(mode: str) -> None:
    states, expected = states_and_observations()
    vector = make_vector(mode)
    for _ in range(2):
        observations, infos = reset_to_states(vector, states)
        np.testing.assert_array_equal(observations["heightmap"], expected)
        assert infos["is_valid"].tolist() == [True] * 3
        assert list(vector.call("get_state")) == states
        vector.step(np.stack(vector.call("expert_action")))
    with pytest.raises(ValueError, match=r"^states must be 3 states, one per member, got 2"):
        reset_to_states(vector, states[:2])
    vector.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_members_begin_at_states_after_the_end_of_their_episodes(mode: str) -> None:
    states, _ = states_and_observations()
    vector = make_vector(mode)
    vector.reset(seed=0)
    ended = False
    while not ended:
        _, _, terminations, truncations, _ = vector.step(np.stack(vector.call("expert_action")))
        ended = bool((terminations | truncations).any())
    reset_to_states(vector, states)
    vector.step(np.zeros((3, 5), np.float32))
    steps = [state.steps for state in vector.call("get_state")]
    assert steps == [state.steps + 1 for state in states]
    vector.close()


def test_states_are_refused_where_they_would_be_lost() -> None:
    vector = make_vector("async", shared_memory=False)
    with pytest.raises(ValueError, match=r"^envs must have shared_memory=True, got shared_memory=False$"):
        reset_to_states(vector, states_and_observations()[0])
    vector.close()


def test_members_of_sb3_begin_at_states_of_their_own() -> None:
    states, expected = states_and_observations()
    vector = DummyVecEnv([partial(gymnasium.make, ENV_ID, obs_size=32)] * 3)
    vector.set_options([{"state": state} for state in states])
    observations: Any = vector.reset()
    np.testing.assert_array_equal(observations["heightmap"], expected)
    vector.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_expert_of_wrapped_members_acts_in_their_action_space(mode: str) -> None:
    rescale = partial(RescaleAction, min_action=np.float32(0.0), max_action=np.float32(2.0))
    vector = gymnasium.make_vec(ENV_ID, 2, mode, wrappers=[rescale], obs_size=32)
    vector.reset(seed=3)
    successes = np.zeros(2, bool)
    for _ in range(25):
        actions = np.stack(vector.call("expert_action"))
        assert actions in vector.action_space
        *_, infos = vector.step(actions)
        successes |= infos["is_success"]
    assert successes.all()
    vector.close()
