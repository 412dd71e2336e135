"""Goal-conditioned environments: interface of Gymnasium-Robotics, rewards equal to success, HER."""

import math
import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common import env_checker

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.geometry import Pose
from bulletarm_gym.wrappers import GoalObservation

TASKS = ("BlockReaching", "BlockPushing", "BlockPulling", "BlockStacking")


def goal_env(task: str, **parameters: Any) -> GoalObservation:
    parameters = {"observation": "state", **parameters}
    return GoalObservation(gymnasium.make(f"BulletArm/CloseLoop{task}-v0", **parameters))


@pytest.mark.parametrize("task", TASKS)
def test_checks_of_gymnasium_and_sb3_are_clean(task: str) -> None:
    env = goal_env(task)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_env(env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*(unwrapped version|infinity).*")
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_rewards_are_the_success_of_the_task_in_valid_scenes(task: str) -> None:
    """In every step of the expert, and for all steps at once."""
    env, rng = goal_env(task), np.random.default_rng(0)
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        steps, rewards, terminated, truncated = [], [], False, False
        while not (terminated or truncated or sum(rewards) > 2.0):
            expert = env.get_wrapper_attr("expert_action")()
            action = env.action_space.sample() if rng.random() < 0.2 else expert
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == float(info["is_success"]) or not info["is_valid"]
            assert terminated == env.compute_terminated(*_goals(observation), info)
            steps.append(observation)
            rewards.append(reward)
        batch = [np.stack([step[name] for step in steps]) for name in ("achieved_goal", "desired_goal")]
        assert env.compute_reward(*batch, [info] * len(steps)).tolist() == rewards
        assert terminated or sum(rewards) > 0.0
    env.close()


def _goals(observation: dict[str, Any]) -> tuple[Any, Any]:
    return observation["achieved_goal"], observation["desired_goal"]


def test_episode_continues_after_success_until_the_limit_of_steps() -> None:
    env = goal_env("BlockReaching", max_steps=7)
    env.reset(seed=0)
    ends, rewards = [], []
    for _ in range(7):
        _, reward, *end, _ = env.step(env.get_wrapper_attr("expert_action")())
        ends.append(tuple(end))
        rewards.append(reward)
    assert ends == [(False, False)] * 6 + [(False, True)]
    assert rewards[-1] == 1.0 and 0.0 < sum(rewards) < 7.0
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.close()


def test_continued_steps_are_those_of_a_copy() -> None:
    env = goal_env("BlockReaching")
    env.reset(seed=0)
    for _ in range(5):
        _, reward, *_ = env.step(env.get_wrapper_attr("expert_action")())
    assert reward == 1.0
    copy = pickle.loads(pickle.dumps(env))
    action = env.action_space.sample()
    for expected, found in zip(env.step(action)[0].values(), copy.step(action)[0].values(), strict=True):
        assert np.array_equal(expected, found)
    env.close()
    copy.close()


def test_invalid_scene_terminates() -> None:
    env = goal_env("BlockPushing")
    env.reset(seed=0)
    env.unwrapped.scene["cube"].place(Pose((0.9, 0.0, 0.025)))  # type: ignore[attr-defined]
    _, reward, terminated, truncated, info = env.step(np.zeros(5))
    assert (reward, terminated, truncated, info["is_success"]) == (0.0, True, False, False)
    env.close()


def test_goals_of_the_tasks_are_positions_and_gaps() -> None:
    shapes = {}
    for task in TASKS:
        env = goal_env(task)
        observation, _ = env.reset(seed=0)
        shapes[task] = observation["achieved_goal"].shape
        scene = env.unwrapped.scene  # type: ignore[attr-defined]
        if task == "BlockReaching":
            distance = math.dist(scene.robot.pose.position, scene["cube"].pose.position)
            assert np.linalg.norm(np.subtract(*_goals(observation))) == pytest.approx(distance)
        if task == "BlockPulling":
            assert observation["achieved_goal"] > 0.0 == observation["desired_goal"]
        env.close()
    assert shapes == dict(zip(TASKS, [(3,), (2,), (1,), (4,)], strict=True))


def test_other_tasks_and_images_are_refused() -> None:
    for task, parameters, message in (
        ("BlockPicking", {}, r"BlockPicking is not goal-conditioned"),
        ("DrawerOpening", {}, r"DrawerOpening is not goal-conditioned"),
        ("BlockReaching", {"observation": "image"}, r"env must observe vectors, got Dict\('heightmap"),
    ):
        with pytest.raises(ValueError, match=message):
            goal_env(task, **parameters)


def test_her_relabels_goals() -> None:
    env = goal_env("BlockReaching", max_steps=10)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={"net_arch": [8]},
        learning_starts=30,
        batch_size=8,
        buffer_size=100,
        seed=0,
    )
    model.learn(42)
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    samples = model.replay_buffer.sample(200)
    assert float(samples.rewards.mean()) > 0.1, "the future goals of 80 % of the samples are often reached"
    env.close()
