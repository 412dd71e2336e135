"""The reward ``"progress"``: bounded, potential-based, a function of the state, for every task."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import idle, is_open_loop, make_env

import bulletarm_gym
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.tasks.progress import DISCOUNT

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/CloseLoopBlockStacking-v0"
IDS = (PICKING, STACKING, "BulletArm/CloseLoopDrawerOpening-v0", "BulletArm/OpenLoopHouseBuilding1-v0")
SENSORS = {"observation": ["holding"], "reward": "progress"}


def rewards_to_the_end(env: ManipulationEnv, before: int = 0) -> tuple[list[float], bool]:
    """Return the rewards of idle steps and then the expert's, and whether the episode terminated."""
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        action = idle(env) if len(rewards) < before else env.expert_action()
        _, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
    return rewards, terminated


def discounted(rewards: list[float]) -> float:
    return sum(DISCOUNT**step * reward for step, reward in enumerate(rewards))


@pytest.mark.parametrize("env_id", IDS)
def test_shaping_subtracts_the_same_potential_from_the_return_of_all_actions(make: Make, env_id: str) -> None:
    """Ng et al. 1999: so the order of policies does not change; at the end the potential is 0."""
    env = make(env_id, **SENSORS)
    starts = []
    for before in (0, 2):
        env.reset(seed=3)
        rewards, terminated = rewards_to_the_end(env, before)
        assert terminated
        starts.append(discounted([0.0] * (len(rewards) - 1) + [1.0]) - discounted(rewards))
    assert starts[0] == pytest.approx(starts[1], abs=1e-9)
    assert 0.0 <= starts[0] < 1.0


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_progress_rewards_the_expert_and_punishes_the_way_back(make: Make, env_id: str) -> None:
    env = make(env_id, **SENSORS)
    env.reset(seed=0)
    rewards, _ = rewards_to_the_end(env)
    assert min(rewards) > 0.0 and max(rewards[:-1]) < 1.0
    env.reset(seed=0)
    for _ in range(3):
        action = env.expert_action()
        env.step(action)
    assert env.step(-action)[1] < 0.0


def test_progress_rewards_a_grasp_and_punishes_its_loss(make: Make) -> None:
    env = make(PICKING, **SENSORS)
    env.reset(seed=0)
    while not env.step(env.expert_action())[-1]["is_held"]:
        pass
    assert env.step([1.0, 0.0, 0.0, 0.0, 0.0])[1] < -0.3


@pytest.mark.parametrize("env_id", IDS)
def test_shaped_rewards_follow_from_the_state(make: Make, env_id: str) -> None:
    """Also in another instance, in a copy, and if the state was set between two steps."""
    env, other = make(env_id, **SENSORS), make(env_id, 1, **SENSORS)
    env.reset(seed=1)
    env.step(env.expert_action())
    state, action = env.get_state(), env.expert_action()
    reward = env.step(action)[1]
    other.reset(seed=9)
    other.set_state(state)
    assert other.step(action)[1] == reward
    env.reset(options={"state": state})
    copy = pickle.loads(pickle.dumps(env))
    assert copy.step(action)[1] == env.step(action)[1] == reward
    copy.close()


def test_invalid_scene_costs_the_progress(make: Make) -> None:
    env = make(PICKING, **SENSORS)
    env.reset(seed=0)
    env.scene["cube"].place(env.scene["cube"].pose.__class__((0.9, 0.0, 0.025)))
    _, reward, terminated, _, info = env.step(idle(env))
    assert terminated and not info["is_valid"] and reward < 0.0


def test_the_same_episode_with_and_without_shaping(make: Make) -> None:
    plain = make(STACKING, observation=["holding"])
    shaped = make(STACKING, **SENSORS)
    infos: list[list[Any]] = []
    for env in (plain, shaped):
        env.reset(seed=2)
        found, ended = [], False
        while not ended:
            _, _, terminated, truncated, info = env.step(env.expert_action())
            found.append([terminated, truncated, info, env.scene.robot.pose])
            ended = terminated or truncated
        infos.append(found)
    assert infos[0] == infos[1]


@pytest.mark.slow
@pytest.mark.parametrize("env_id", bulletarm_gym.ENV_IDS)
def test_expert_makes_progress_in_every_task(env_id: str) -> None:
    env = make_env(env_id, **SENSORS)
    for seed in range(2):
        env.reset(seed=seed)
        rewards, terminated = rewards_to_the_end(env)
        shaped = np.array(rewards[:-1])
        assert terminated and (np.abs(rewards) <= 1.0).all()
        assert is_open_loop(env_id) or (shaped > 0.0).mean() > 0.5, env_id
        finished, parts = env.task.parts(env.scene, np.random.default_rng(0))
        assert finished >= parts - 1
    env.close()
