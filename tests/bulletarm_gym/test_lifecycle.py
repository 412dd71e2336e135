"""The life of an environment: before the first reset, after the end of an episode, after close()."""

import pickle
import re
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from rollouts import idle, make_env

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.scene.state import EnvState

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
CLOSED = r"^the environment is closed"
ENDED = r"^the episode has ended\. Call reset\(\)"


def test_nothing_works_before_reset(typical_id: str) -> None:
    env = make_env(typical_id)
    for call in (lambda: env.step(idle(env)), env.expert_action, env.get_state):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    env.close()


@pytest.mark.parametrize(
    "options", ["foo", "", 3, ["start"], {"scenery": "alps"}, {"new_scene": 1}, {1: 2}], ids=repr
)
def test_reset_rejects_other_options(typical_env: ManipulationEnv, options: Any) -> None:
    message = rf"^options must be None or a dict with .*, got {re.escape(repr(options))}$"
    with pytest.raises(ValueError, match=message):
        typical_env.reset(options=options)
    typical_env.reset(options={})


def play_to_the_end(env: ManipulationEnv, seed: int) -> EnvState:
    """Return the last state before the end."""
    env.reset(seed=seed)
    over = False
    while not over:
        state = env.get_state()
        _, _, terminated, truncated, _ = env.step(env.expert_action())
        over = terminated or truncated
    return state


def test_no_step_after_the_end(env: ManipulationEnv) -> None:
    before_the_end = play_to_the_end(env, 0)
    at_the_end = env.get_state()
    assert at_the_end.ended and not before_the_end.ended
    assert env.expert_action() in env.action_space
    for state in (None, at_the_end):
        if state is not None:
            env.reset()
            env.set_state(state)
        with pytest.raises(gymnasium.error.ResetNeeded, match=ENDED):
            env.step(idle(env))
        assert env.get_state() == at_the_end
    env.set_state(before_the_end)
    assert any(env.step(env.expert_action())[2:4])
    env.reset()
    env.step(env.expert_action())


def test_no_step_after_the_time_limit(make: Make) -> None:
    env = make(PICKING, max_steps=2)
    env.reset(seed=0)
    assert [env.step(idle(env))[3] for _ in range(2)] == [False, True]
    with pytest.raises(gymnasium.error.ResetNeeded, match=ENDED):
        env.step(idle(env))
    copy = pickle.loads(pickle.dumps(env))
    with pytest.raises(gymnasium.error.ResetNeeded, match=ENDED):
        copy.step(idle(copy))
    copy.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vectors_reset_what_has_ended(mode: AutoresetMode) -> None:
    if mode == AutoresetMode.DISABLED:
        pytest.skip("resets nothing")
    options = {"autoreset_mode": mode}
    vector = gymnasium.make_vec(PICKING, 2, "sync", vector_kwargs=options, obs_size=16, max_steps=2)
    vector.reset(seed=0)
    actions = np.zeros((2, 5), np.float32)
    assert sum(vector.step(actions)[3].all() for _ in range(6)) >= 2
    vector.close()


def test_close_twice(typical_id: str) -> None:
    env = make_env(typical_id)
    env.reset(seed=0)
    env.close()
    env.close()
    fresh = make_env(typical_id)
    fresh.close()
    fresh.close()


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_closed_environment_says_so(wrapped: bool) -> None:
    """PyBullet gives the number of a closed server to the next one."""
    env = gymnasium.make(PICKING, obs_size=16)
    env.reset(seed=0)
    inner = env.unwrapped
    action, state = inner.expert_action(), inner.get_state()
    env.close()
    fresh = make_env(PICKING, obs_size=16)
    outer: Any = env if wrapped else inner
    calls: list[Callable[[], Any]] = [
        outer.reset,
        lambda: outer.reset(seed=0, options="foo"),
        lambda: outer.step(action),
        lambda: outer.step("open"),
        outer.render,
        inner.expert_action,
        inner.observe,
        inner.look,
        inner.get_state,
        inner.measure,
        inner.viewer.close_up,
        lambda: inner.set_state(state),
        lambda: inner.decode_action(action),
        lambda: pickle.dumps(inner),
    ]
    for call in calls:
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match=CLOSED):
            call()
    fresh.close()


def test_an_environment_closed_before_its_first_reset_says_so() -> None:
    env = make_env(PICKING, obs_size=16)
    env.close()
    for call in (env.reset, env.expert_action, env.get_state, lambda: env.step(idle(env))):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match=CLOSED):
            call()
