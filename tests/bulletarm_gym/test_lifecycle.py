"""Environments before the first reset, after the end of an episode and after close(), and their memory."""

import gc
import pickle
import re
from collections.abc import Callable
from typing import Any

import gymnasium
import psutil
import pybullet
import pytest
from rollouts import idle, make_env

from bulletarm_gym.env import ManipulationEnv

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
ENDED = r"^the episode has ended\. Call reset\(\)"
MEGABYTE = 2**20
MAX_SERVERS = 1024
"""Number of PyBullet's physics servers in a process."""


@pytest.mark.parametrize(
    "options", ["foo", "", 3, ["start"], {"scenery": "alps"}, {"new_scene": 1}, {1: 2}], ids=repr
)
def test_reset_rejects_other_options(picking: ManipulationEnv, options: Any) -> None:
    with pytest.raises(ValueError, match=rf"^options must be .*, got {re.escape(repr(options))}$"):
        picking.reset(options=options)
    picking.reset(options={})


@pytest.mark.parametrize("env_id", [PICKING, "BulletArm/OpenLoopHouseBuilding2-v0"])
def test_no_step_after_the_end(make: Make, env_id: str) -> None:
    env, over = make(env_id), False
    env.reset(seed=0)
    while not over:
        before_the_end = env.get_state()
        *_, terminated, truncated, _ = env.step(env.expert_action())
        over = terminated or truncated
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


def test_no_step_after_the_time_limit(make: Make) -> None:
    env = make(PICKING, max_steps=2)
    env.reset(seed=0)
    assert [env.step(idle(env))[3] for _ in range(2)] == [False, True]
    copy = pickle.loads(pickle.dumps(env))
    for instance in (env, copy):
        with pytest.raises(gymnasium.error.ResetNeeded, match=ENDED):
            instance.step(idle(instance))
    copy.close()


def test_environment_needs_a_reset_and_is_closed_twice(typical_id: str) -> None:
    env = make_env(typical_id, obs_size=32)
    calls = (lambda: env.step(idle(env)), env.expert_action, env.get_state)
    for call in calls:
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    env.close()
    env.close()
    for call in (env.reset, *calls):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            call()


@pytest.mark.parametrize("wrapped", [True, False])
def test_closed_environment_rejects_every_call(wrapped: bool) -> None:
    """PyBullet gives the number of a closed server to the next one."""
    env = gymnasium.make(PICKING, obs_size=16)
    env.reset(seed=0)
    inner: Any = env.unwrapped
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
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            call()
    fresh.close()


# Memory


def servers() -> int:
    gc.collect()
    return sum(bool(pybullet.isConnected(number)) for number in range(MAX_SERVERS))


def used() -> int:
    gc.collect()
    return int(psutil.Process().memory_info().rss)


def test_resets_and_states_do_not_grow(typical_env: ManipulationEnv) -> None:
    def play(episodes: int) -> None:
        for _ in range(episodes):
            typical_env.reset()
            typical_env.step(typical_env.expert_action())
            typical_env.set_state(typical_env.get_state())

    play(5)
    before = used()
    play(15)
    assert used() - before < 2.5 * MEGABYTE


def test_server_is_released_by_close_by_the_collector_and_after_an_error() -> None:
    before = servers()
    env = make_env(PICKING, obs_size=32)
    env.reset(seed=0)
    assert servers() == before + 1
    env.close()
    assert servers() == before
    env = make_env(PICKING, obs_size=32)
    env.reset(seed=0)
    del env
    assert servers() == before
    for parameters in ({"robot": "nobody"}, {"reward": "nowhere:nothing"}):
        with pytest.raises(ValueError, match=next(iter(parameters))):
            make_env(PICKING, **parameters)
    assert servers() == before


def test_closed_environment_leaves_no_objects(typical_id: str) -> None:
    make_env(typical_id).close()
    gc.collect()
    before = len(gc.get_objects())
    for _ in range(3):
        make_env(typical_id).close()
    gc.collect()
    assert len(gc.get_objects()) - before < 100
