"""Environments divided among processes: equal to those of one, and well-behaved when a worker fails."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_extensions.vec_env import SplitVecEnv, WorkerError

ENV_ID = "bulletarm_gym:BulletArm/CloseLoopBlockPicking-v0"
OPTIONS = {"obs_size": 24, "max_steps": 4}


class Reversed(gym.ActionWrapper[Any, Any, Any]):
    """Does the contrary of what it is told."""

    def action(self, action: Any) -> Any:
        return -action


class Peeping(gym.Wrapper[Any, Any, Any, Any]):
    """Looks inside at every step."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["steps"] = self.unwrapped.get_state().steps  # type: ignore[attr-defined]
        return observation, reward, terminated, truncated, info


class Short(gym.Wrapper[Any, Any, Any, Any]):
    """Ends episodes before the environment does, and goes on where that would end."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, not truncated, info


def make(wrapper: Any = None, **options: Any) -> gym.Env[Any, Any]:
    env = gym.make(ENV_ID, **(OPTIONS | options))
    return Monitor(env if wrapper is None else wrapper(env))


def split(number: int = 5, processes: int = 2, start_method: str = "fork", **options: Any) -> SplitVecEnv:
    return SplitVecEnv([partial(make, **options)] * number, processes, start_method)


def plain(infos: Any) -> list[dict[str, Any]]:
    """Infos without the seconds that episodes took."""
    return [{key: value for key, value in info.items() if key != "episode"} for info in infos]


def assert_equal_rollouts(left: VecEnv, right: VecEnv, steps: int = 10, start: bool = True) -> None:
    rng = np.random.default_rng(0)
    if start:
        for env in (left, right):
            env.seed(3)
        np.testing.assert_equal(left.reset(), right.reset())
    for _ in range(steps):
        actions = rng.uniform(-1, 1, (left.num_envs, 5)).astype(np.float32)
        ours, theirs = left.step(actions), right.step(actions)
        np.testing.assert_equal(ours[:3], theirs[:3])
        assert [value.dtype for value in ours[1:3]] == [value.dtype for value in theirs[1:3]]
        np.testing.assert_equal(plain(ours[3]), plain(theirs[3]))
        np.testing.assert_equal(left.reset_infos, right.reset_infos)
    np.testing.assert_equal(
        [state.world for state in left.env_method("get_state")],
        [state.world for state in right.env_method("get_state")],
    )


@pytest.mark.parametrize(
    ("number", "processes", "start_method"),
    [(5, 2, "forkserver"), (3, 2, "spawn"), (5, 3, "fork"), (2, 4, "fork"), (2, 1, "fork")],
)
def test_equals_one_process(number: int, processes: int, start_method: str) -> None:
    env, dummy = split(number, processes, start_method), DummyVecEnv([make] * number)
    assert_equal_rollouts(env, dummy)
    env.close()
    dummy.close()


class Rigged:
    """A lock that lets one process after the other have an environment, whichever is faster."""

    def __init__(self, lock: Any, turns: str) -> None:
        self.lock = lock
        self.turns = itertools.cycle(turns)
        lock.acquire()
        self.release()

    def acquire(self, block: bool) -> bool:
        return self.turn == "h"

    def release(self) -> None:
        self.turn = next(self.turns)
        if self.turn == "w":
            self.lock.release()


@pytest.mark.parametrize("wrapper", [None, Reversed, Peeping, Short])
@pytest.mark.parametrize("turns", ["w", "h", "wwh"])
def test_a_lent_environment(wrapper: Any, turns: str) -> None:
    """Stepped by the worker, at home, or by turns."""
    env, dummy = split(3, wrapper=wrapper), DummyVecEnv([partial(make, wrapper)] * 3)
    (lent,) = env._lent.values()
    lent.lock = Rigged(lent.lock, turns)  # type: ignore[assignment]
    assert_equal_rollouts(env, dummy)
    assert lent.stays == (wrapper is not None and not (turns == "h" and wrapper is not Peeping))
    env.close()
    dummy.close()


def test_calls_reach_a_lent_environment() -> None:
    env, dummy = split(3), DummyVecEnv([make] * 3)
    (lent,) = env._lent.values()
    lent.lock = Rigged(lent.lock, "w")  # type: ignore[assignment]
    assert_equal_rollouts(env, dummy, 3)
    states = dummy.env_method("get_state")
    np.testing.assert_equal(env.env_method("expert_action"), dummy.env_method("expert_action"))
    assert_equal_rollouts(env, dummy, 6, start=False)
    for vector in (env, dummy):  # as a checkpoint does
        for index, state in enumerate(states):
            vector.env_method("set_state", state, indices=index)
            vector.env_method("set_wrapper_attr", "rewards", [0.0] * 3, indices=index)
    assert_equal_rollouts(env, dummy, 6, start=False)
    assert not lent.stays
    for vector in (env, dummy):
        vector.env_method("limit_steps", 2)
        vector.reset()
    assert_equal_rollouts(env, dummy, 6, start=False)
    assert lent.stays
    env.close()
    dummy.close()


def test_attributes() -> None:
    env = split(3)
    assert env.has_attr("expert_action") and not env.has_attr("no_such_thing")
    assert [spec.id for spec in env.get_attr("spec")] == ["BulletArm/CloseLoopBlockPicking-v0"] * 3
    env.set_attr("label", 7, indices=[1, 2])
    assert env.get_attr("label", indices=[2, 1]) == [7, 7]
    assert env.env_is_wrapped(Monitor) == [True] * 3 and env.env_is_wrapped(Reversed, 0) == [False]
    copy = env.get_attr("unwrapped", indices=2)[0]
    copy.limit_steps(1)
    assert env.get_attr("unwrapped", indices=2)[0].config.max_steps == OPTIONS["max_steps"]
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.get_attr("spec")


def test_pictures() -> None:
    env = split(3, render_mode="rgb_array")
    env.reset()
    images = env.get_images()
    assert len(images) == 3 and all(image is not None and image.shape == (480, 480, 3) for image in images)
    env.close()


def test_environments_without_a_state() -> None:
    """They stay where they are; observations may be plain arrays, actions numbers."""
    env = make_vec_env("CartPole-v1", 3, seed=0, vec_env_cls=SplitVecEnv, vec_env_kwargs={"processes": 2})
    dummy = make_vec_env("CartPole-v1", 3, seed=0)
    np.testing.assert_equal(env.reset(), dummy.reset())
    for number in range(40):
        actions = np.array([number % 2, 1, 0])
        np.testing.assert_equal(env.step(actions)[:3], dummy.step(actions)[:3])
    assert not env._lent  # type: ignore[attr-defined]
    env.close()


def test_learns_as_in_one_process() -> None:
    def weights(env: VecEnv) -> Any:
        model = PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, seed=0, device="cpu")
        found = model.learn(12).policy.state_dict()
        env.close()
        return {key: value.numpy() for key, value in found.items()}

    np.testing.assert_equal(weights(split(3)), weights(DummyVecEnv([make] * 3)))


@pytest.mark.parametrize("bad", [0, 2])
def test_error_of_an_environment(bad: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process as it is, in a worker with its traceback; nothing is left running."""
    closed: list[Any] = []
    monkeypatch.setattr(Monitor, "close", lambda env: closed.append(env))
    env = split(4)
    env.reset()
    actions = np.zeros((4, 5), np.float32)
    actions[bad] = np.nan
    with pytest.raises(ValueError if bad == 0 else WorkerError, match="finite") as caught:
        env.step(actions)
    if bad:
        assert "SplitVecEnv worker 1 failed: ValueError" in str(caught.value)
        assert "decode_action" in str(caught.value.__cause__)
    assert len(closed) == 2  # those of this process
    assert not multiprocessing.active_children()
    env.close()


def test_killed_worker_is_named() -> None:
    """Under fork the other worker holds a copy of this one's pipe."""
    env = split(3, 3, "fork")
    env.reset()
    pid = env._workers[0].process.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(WorkerError, match="SplitVecEnv worker 1 ended with exit code -9"):
        env.step(np.zeros((3, 5), np.float32))
    assert not multiprocessing.active_children()
    env.close()


def test_error_while_a_worker_begins() -> None:
    with pytest.raises(WorkerError, match="max_steps: got -1"):
        SplitVecEnv([make, partial(make, max_steps=-1)], 2, "fork").reset()
    assert not multiprocessing.active_children()


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="env_fns"):
        SplitVecEnv([])
    with pytest.raises(ValueError, match="processes: got 0"):
        SplitVecEnv([make], 0)


def test_ends_between_a_step_and_its_answer() -> None:
    env = split(3)
    env.reset()
    env.step_async(np.zeros((3, 5), np.float32))
    with pytest.raises(RuntimeError, match="step_wait"):
        env.get_attr("spec")
    env.close()
    assert not multiprocessing.active_children()
