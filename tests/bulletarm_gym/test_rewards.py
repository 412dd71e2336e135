"""Rewards: users' functions, and ``"progress"``, which is bounded, potential-based and for every task."""

import math
import pickle
import re

import gymnasium
import numpy as np
import pytest
from rollouts import PICKING, idle, is_open_loop, make_env

from bulletarm_gym.geometry import Pose
from bulletarm_gym.tasks.progress import DISCOUNT

REACHING = "BulletArm/CloseLoopBlockReaching-v0"
STACKING = "BulletArm/CloseLoopBlockStacking-v0"
IDS = (PICKING, STACKING, "BulletArm/CloseLoopDrawerOpening-v0", "BulletArm/OpenLoopHouseBuilding1-v0")
SENSORS = {"observation": ["holding"], "reward": "progress"}


def rewards_to_the_end(env, before=0):
    """Return the rewards of idle steps and then the expert's, and whether the episode terminated."""
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        action = idle(env) if len(rewards) < before else env.expert_action()
        _, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
    return rewards, terminated


def discounted(rewards):
    return sum(DISCOUNT**step * reward for step, reward in enumerate(rewards))


def paid(scene, outcome):
    return 0.25 + 2.0 * outcome["is_success"]


@pytest.mark.parametrize("kind", ["path", "function", "lambda"])
def test_rewards_are_functions_of_scene_and_info(kind):
    path = f"{paid.__module__}:paid"
    reward = {"path": path, "function": paid, "lambda": lambda scene, info: paid(scene, info)}[kind]
    env = gymnasium.make(REACHING, obs_size=16, reward=reward)
    again = gymnasium.make(env.spec)
    for each in (env, again, *([] if kind == "lambda" else [pickle.loads(pickle.dumps(env))])):
        core = each.unwrapped
        each.reset(seed=0)
        rewards = [each.step(core.expert_action())[1] for _ in range(3)]
        assert rewards == [0.25, 0.25, 2.25]
        assert kind == "lambda" or (core.config.reward == path and path in each.spec.to_json())


def test_rewards_must_be_finite_numbers():
    value = [None]
    env = make_env(PICKING, obs_size=16, reward=lambda scene, outcome: value[0])
    for value[0] in (None, math.nan, "1.0", [1.0]):
        env.reset(seed=0)
        with pytest.raises(
            ValueError, match=rf"^reward must be .*, got {re.escape(repr(value[0]))}: .*:.*lambda"
        ):
            env.step(idle(env))
    for path in ("no:where", "math:pi"):
        with pytest.raises(ValueError, match=rf"reward must be .*, got '{path}'"):
            make_env(PICKING, reward=path)


@pytest.mark.parametrize("env_id", IDS)
def test_shaping_subtracts_the_same_potential_from_the_return_of_all_actions(make, env_id):
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


def test_progress_rewards_the_expert_and_punishes_lost_progress(make):
    env = make(PICKING, **SENSORS, seed=0)
    rewards, _ = rewards_to_the_end(env)
    assert min(rewards) > 0.0 and max(rewards[:-1]) < 1.0
    env.reset(seed=0)
    while not env.step(env.expert_action())[-1]["is_held"]:
        pass
    assert env.step([1.0, 0.0, 0.0, 0.0, 0.0])[1] < -0.3
    env.scene["cube"].place(Pose((0.9, 0.0, 0.025)))
    _, reward, terminated, _, info = env.step(idle(env))
    assert terminated and not info["is_valid"] and reward < 0.0


@pytest.mark.slow
def test_expert_makes_progress_in_every_task(env_id):
    env = make_env(env_id, **SENSORS)
    env.reset(seed=0)
    rewards, terminated = rewards_to_the_end(env)
    assert terminated and (np.abs(rewards) <= 1.0).all()
    assert is_open_loop(env_id) or (np.array(rewards[:-1]) > 0.0).mean() > 0.5
    finished, parts = env.task.parts(env.scene, np.random.default_rng(0))
    assert finished >= parts - 1
