"""Recorded files hold what the environment did: states, actions, seeds and attempts."""

import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from gymnasium.wrappers import ClipAction, RecordEpisodeStatistics, RescaleAction, TimeLimit
from rollouts import PICKING, REACHING, finish
from stable_baselines3.common.monitor import Monitor

from bulletarm_gym.demonstrations import RecordDemonstrations, collect, load, replay
from bulletarm_gym.registry import VARIABLE
from bulletarm_gym.wrappers import ImageObservation

PARAMETERS = {"obs_size": 32, "max_steps": 5}
IDLE = np.array([1, 0, 0, 0, 0], np.float32)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "own.h5"


def record(path, **parameters):
    return RecordDemonstrations(gymnasium.make(REACHING, **{**PARAMETERS, **parameters}), path)


def play(env, seed, by_expert=True):
    """Act until the episode ends; return whether it succeeds."""
    env.reset(seed=seed)
    if by_expert:
        return finish(env)[0]
    while not any(env.step(IDLE)[2:4]):
        pass
    return False


def replayed(path):
    """Repeat all episodes of a file; return them."""
    found = load(path)
    env = found.make_env()
    for number in range(len(found)):
        assert list(replay(found, number, env.unwrapped)) == list(range(len(found[number]) + 1))
    env.close()
    return found


def seeds(path):
    return [episode.seed for episode in load(path)]


def test_recorded_expert_equals_collected_expert(path):
    collected = collect(REACHING, 1, seed=0, env_kwargs=PARAMETERS)
    assert play(record(path), collected[0].seed)
    recorded = load(path)
    assert recorded.about["planner"] == "human"
    assert {**recorded.about, "planner": "", "seed": 0} == {**collected.about, "planner": "", "seed": 0}
    for name, values in vars(collected[0]).items():
        np.testing.assert_equal(getattr(recorded[0], name), values)


@pytest.mark.parametrize("change", ["option", "place", "set_state"])
def test_episode_begins_at_the_state_of_the_first_action(change, path):
    env = record(path)
    core = env.unwrapped
    env.reset(seed=8)
    state = core.get_state()
    if change == "option":
        env.reset(seed=2, options={"state": state})
    elif change == "place":
        item = core.scene.objects[0]
        x, y, z = item.pose.position
        item.place(item.pose._replace(position=(x, -y + 0.03, z)))
    else:
        env.step(IDLE)
        core.set_state(state)
    expected = core.get_state()
    heights = core.observe()["heightmap"]
    assert finish(env)[0]
    found = replayed(path)
    (episode,) = found
    assert episode.state == expected and episode.seed is None
    np.testing.assert_allclose(episode.observations["heightmap"][0], heights, atol=1e-4)
    assert found.attempts == (1 if change == "place" else 2)


def test_recorded_actions_are_inside_the_action_space(path):
    """Whatever outer wrappers do."""
    inner = record(path)
    env = RescaleAction(inner, np.float32(0.0), np.float32(1.0))
    env.reset(seed=0)
    for action in (np.zeros(4), np.full(5, np.nan)):
        with pytest.raises(ValueError):
            inner.step(action)
    over = False
    while not over:
        action = env.get_wrapper_attr("expert_action")().astype(np.float64)
        action[action == 1.0] *= 3.0
        over = any(env.step(action)[2:4])
    assert all(action in inner.action_space for action in replayed(path)[0].actions)


def test_recorder_rejects_inner_wrappers_that_change_episodes(path):
    for wrap in (ClipAction, ImageObservation, partial(TimeLimit, max_episode_steps=3)):
        env = wrap(gymnasium.make(REACHING, **PARAMETERS))
        name = type(env).__name__
        with pytest.raises(ValueError, match=rf"got {name}\. Put the recorder inside: {name}\("):
            RecordDemonstrations(env, path)


def test_inner_wrappers_may_observe_and_the_spec_makes_a_recorder_of_the_same_file(path):
    env = RecordDemonstrations(Monitor(RecordEpisodeStatistics(gymnasium.make(REACHING, **PARAMETERS))), path)
    assert play(env, 0)
    again = gymnasium.make(record(path).spec)
    assert len(again) == 1 and play(again, 1) and seeds(path) == [0, 1]


def test_attempts_count_failed_and_abandoned_episodes(path):
    env = record(path)
    assert not play(env, 1, by_expert=False)
    assert len(env) == 0 and not path.exists()
    assert play(env, 2**64 + 1)
    assert seeds(path) == [2**64 + 1] and load(path).attempts == 2
    for seed in (3, 4):
        env.reset(seed=seed)
        env.step(IDLE)
    assert not play(env, 6, by_expert=False)
    env.close()
    env.close()
    assert (len(load(path)), load(path).attempts) == (1, 5)


def test_recorders_of_a_vector_environment_keep_all_episodes(path):
    envs = AsyncVectorEnv([partial(record, path)] * 2)
    envs.reset(seed=0)
    successes = 0
    for _ in range(8):
        *_, infos = envs.step(np.stack(envs.call("expert_action")))
        successes += int(np.sum(infos["is_success"]))
    envs.close()
    assert len(load(path)) == successes > 2 and load(path).attempts >= successes


def test_failed_write_keeps_the_episode(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = record(Path("new/own.h5"))
    monkeypatch.chdir("/")  # a relative path stays where it was
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError("no space left")))
        with pytest.raises(OSError, match="no space left"):
            play(env, 1)
    assert len(env) == 1
    env.close()
    assert seeds(tmp_path / "new" / "own.h5") == [1]


def test_recorder_rejects_a_file_of_other_parameters(path, tmp_path):
    play(record(path), 0)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"with max_steps=9, obs_size=48, got .* with max_steps=5, obs_size"):
        record(path, obs_size=48, max_steps=9)
    with pytest.raises(ValueError, match=r"with surface='ramp', got .* with surface='flat'"):
        record(path, surface="ramp")
    for env, file, message in (
        (gymnasium.make(PICKING, **PARAMETERS), path, f"env_id='{PICKING}'"),
        (gymnasium.make("CartPole-v1"), path, r"^env must be .*CartPole"),
        (gymnasium.make(REACHING), tmp_path, f"^path must be a file such as .*, got the folder {tmp_path}"),
    ):
        with pytest.raises(ValueError, match=message):
            RecordDemonstrations(env, file)
    assert path.read_bytes() == before


OWN_TASK = """
from bulletarm_gym import register_task
from bulletarm_gym.tasks.picking import BlockReaching

class OwnReaching(BlockReaching):
    pass

register_task("OwnReaching", OwnReaching)
"""
REPLAY = """
import gymnasium
from bulletarm_gym.demonstrations import load, replay
found = load("own.h5")
env = found.make_env()
print(type(env.unwrapped.task).__name__, len(list(replay(found, 0, env.unwrapped))) == len(found[0]) + 1)
gymnasium.make("my_recorded_tasks:" + found.env_id)
"""
OWN_ID = "my_recorded_tasks:BulletArm/CloseLoopOwnReaching-v0"


@pytest.mark.usefixtures("own_registrations")
def test_file_of_an_own_task_replays_in_a_fresh_process_that_prints_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "my_recorded_tasks.py").write_text(OWN_TASK)
    monkeypatch.syspath_prepend(tmp_path)
    collect(OWN_ID, 1, seed=0, env_kwargs={"obs_size": 32}, path=tmp_path / "own.h5")
    monkeypatch.setenv(VARIABLE, "{}")
    command = [sys.executable, "-c", REPLAY]
    child = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (child.stdout, child.stderr) == ("OwnReaching True\n", "")
