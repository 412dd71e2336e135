"""Recorded files hold what the environment did: states, actions, seeds and attempts."""

import multiprocessing
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from gymnasium.wrappers import ClipAction, RecordEpisodeStatistics, RescaleAction, TimeLimit, TransformAction
from stable_baselines3.common.monitor import Monitor

from bulletarm_gym.demonstrations import RecordDemonstrations, collect, load, replay
from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
PARAMETERS: dict[str, Any] = {"obs_size": 32, "max_steps": 5}
IDLE = np.array([1, 0, 0, 0, 0], np.float32)


def record(path: Path, **parameters: Any) -> RecordDemonstrations:
    return RecordDemonstrations(gymnasium.make(ENV_ID, **{**PARAMETERS, **parameters}), path)


def finish(env: gymnasium.Env[Any, Any], by_expert: bool = True) -> bool:
    """Act until the episode ends; return whether it succeeds."""
    over, info = False, {"is_success": False}
    while not over:
        action = env.get_wrapper_attr("expert_action")() if by_expert else IDLE
        _, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    return bool(info["is_success"])


def play(env: gymnasium.Env[Any, Any], seed: int | None, by_expert: bool = True) -> bool:
    env.reset(seed=seed)
    return finish(env, by_expert)


def replays(path: Path) -> int:
    """Repeat all episodes of a file; return their number."""
    found = load(path)
    env: Any = found.make_env()
    for number in range(len(found)):
        assert list(replay(found, number, env.unwrapped)) == list(range(len(found[number]) + 1))
    env.close()
    return len(found)


def test_an_expert_recorded_is_an_expert_collected(tmp_path: Path) -> None:
    collected = collect(ENV_ID, 1, seed=0, env_kwargs=PARAMETERS)
    assert play(record(tmp_path / "own.h5"), collected[0].seed)
    recorded = load(tmp_path / "own.h5")
    assert recorded.about["planner"] == "human"
    assert {**recorded.about, "planner": "", "seed": 0} == {**collected.about, "planner": "", "seed": 0}
    for name, values in vars(collected[0]).items():
        np.testing.assert_equal(getattr(recorded[0], name), values)


def test_a_file_grows(tmp_path: Path) -> None:
    for seed in (3, 4):
        play(record(tmp_path / "own.h5"), seed)
    assert [episode.seed for episode in load(tmp_path / "own.h5")] == [3, 4]


def test_long_files_are_written_less_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bulletarm_gym.demonstrations.recording.EPISODES_PER_WRITE", 1.0)
    env, saved = record(tmp_path / "own.h5"), []
    for seed in range(5):
        play(env, seed)
        saved.append(len(load(tmp_path / "own.h5")))
    assert saved == [1, 2, 2, 4, 4] and len(env) == 5
    env.close()
    assert [episode.seed for episode in load(tmp_path / "own.h5")] == list(range(5))
    assert load(tmp_path / "own.h5").attempts == 5


# States


def test_episode_begins_at_the_state_of_the_first_action(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    core: Any = env.unwrapped
    env.reset(seed=8)
    state = core.get_state()
    env.reset(seed=9)
    core.set_state(state)
    assert finish(env)
    episode = load(tmp_path / "own.h5")[0]
    assert episode.state == state and episode.seed is None
    assert replays(tmp_path / "own.h5") == 1


def test_episode_begins_with_the_placed_object(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    core: Any = env.unwrapped
    env.reset(seed=8)
    item = core.scene.objects[0]
    x, y, z = item.pose.position
    item.place(item.pose._replace(position=(x, -y + 0.03, z)))
    expected = core.observe()["heightmap"]
    assert finish(env)
    first = load(tmp_path / "own.h5")[0].observations["heightmap"][0]
    np.testing.assert_allclose(first, expected, atol=1e-4)
    assert replays(tmp_path / "own.h5") == 1


def test_set_state_in_an_episode_begins_another(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    core: Any = env.unwrapped
    env.reset(seed=8)
    state = core.get_state()
    env.step(IDLE)
    core.set_state(state)
    assert finish(env)
    assert load(tmp_path / "own.h5").attempts == 2
    assert replays(tmp_path / "own.h5") == 1


def test_reset_to_a_state_is_recorded(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    env.reset(seed=8)
    state = env.unwrapped.get_state()  # type: ignore[attr-defined]
    env.reset(seed=2, options={"state": state})
    assert finish(env)
    episode = load(tmp_path / "own.h5")[0]
    assert episode.state.world == state.world and episode.seed is None
    assert replays(tmp_path / "own.h5") == 1


# Actions


def test_recorded_actions_are_inside_the_action_space(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    env.reset(seed=0)
    terminated = truncated = False
    while not (terminated or truncated):
        action = env.unwrapped.expert_action().astype(np.float64)  # type: ignore[attr-defined]
        action[np.abs(action) == 1.0] *= 3.0
        *_, terminated, truncated, _ = env.step(action)
    episode = load(tmp_path / "own.h5")[0]
    assert all(action in env.action_space for action in episode.actions)
    assert replays(tmp_path / "own.h5") == 1


def test_actions_of_outer_wrappers_are_recorded_as_the_environment_has_them(tmp_path: Path) -> None:
    assert play(record(tmp_path / "bare.h5"), 0)
    outer = RescaleAction(record(tmp_path / "own.h5"), np.float32(0.0), np.float32(1.0))
    assert play(outer, 0)
    bare, own = (load(tmp_path / name)[0].actions for name in ("bare.h5", "own.h5"))
    np.testing.assert_allclose(own, bare, atol=1e-6)


WRAPPERS: dict[str, Any] = {
    "RescaleAction": partial(RescaleAction, min_action=np.float32(0.0), max_action=np.float32(1.0)),
    "TransformAction": partial(TransformAction, func=np.negative, action_space=None),
    "ClipAction": ClipAction,
    "ImageObservation": ImageObservation,
    "TimeLimit": partial(TimeLimit, max_episode_steps=3),
}


@pytest.mark.parametrize("name", WRAPPERS)
def test_recorder_names_the_wrapper_that_must_be_outside(name: str, tmp_path: Path) -> None:
    env = WRAPPERS[name](gymnasium.make(ENV_ID, **PARAMETERS))
    with pytest.raises(ValueError, match=rf"got \w*{name}\. Put the recorder inside: \w*{name}\("):
        RecordDemonstrations(env, tmp_path / "own.h5")


def test_wrappers_that_only_watch_may_be_inside(tmp_path: Path) -> None:
    env = Monitor(RecordEpisodeStatistics(gymnasium.make(ENV_ID, **PARAMETERS)))
    assert play(RecordDemonstrations(env, tmp_path / "own.h5"), 0)


def test_wrong_actions_are_refused_as_without_a_recorder(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    env.reset(seed=0)
    for action in (np.zeros(4), np.full(5, np.nan)):
        with pytest.raises(ValueError, match="finite numbers"):
            env.step(action)


# Files


def test_failures_count_and_are_not_kept(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    assert not play(env, 1, by_expert=False)
    assert len(env) == 0 and not (tmp_path / "own.h5").exists()
    assert play(env, 2)
    found = load(tmp_path / "own.h5")
    assert (len(found), found.attempts, found[0].seed) == (1, 2, 2)


def test_abandoned_attempts_count(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    for seed in range(3):
        assert play(env, seed)
    for seed in range(3, 6):
        env.reset(seed=seed)
        env.step(IDLE)
    assert not play(env, 6, by_expert=False)
    env.close()
    env.close()
    found = load(tmp_path / "own.h5")
    assert (len(found), found.attempts) == (3, 7)


def work(path: Path, seeds: range) -> None:
    env = record(path)
    for seed in seeds:
        assert play(env, seed)
    env.close()


def test_recorders_of_several_processes_keep_all_episodes(tmp_path: Path) -> None:
    path, context = tmp_path / "own.h5", multiprocessing.get_context("spawn")
    workers = [context.Process(target=work, args=(path, range(4 * n, 4 * n + 4))) for n in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    found = load(path)
    assert sorted(episode.seed or 0 for episode in found) == list(range(12)) and found.attempts == 12


def test_recorders_of_a_vector_environment_keep_all_episodes(tmp_path: Path) -> None:
    envs = AsyncVectorEnv([partial(record, tmp_path / "own.h5")] * 2)
    envs.reset(seed=0)
    successes = 0
    for _ in range(12):
        *_, infos = envs.step(np.stack(envs.call("expert_action")))
        successes += int(np.sum(infos["is_success"]))
    envs.close()
    assert len(load(tmp_path / "own.h5")) == successes > 2


def test_a_relative_path_stays_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = record(Path("new/own.h5"))
    monkeypatch.chdir("/")
    assert play(env, 1)
    env.close()
    assert len(load(tmp_path / "new" / "own.h5")) == 1


def test_failed_write_keeps_the_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = record(tmp_path / "own.h5")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError("no space left")))
        with pytest.raises(OSError, match="no space left"):
            play(env, 1)
    assert len(env) == 1
    env.close()
    assert [episode.seed for episode in load(tmp_path / "own.h5")] == [1]


def test_any_seed_of_gymnasium_is_recorded(tmp_path: Path) -> None:
    seeds = [2**63, 2**64 + 1, 10**38]
    env = record(tmp_path / "own.h5")
    for seed in seeds:
        assert play(env, seed)
    assert [episode.seed for episode in load(tmp_path / "own.h5")] == seeds


def test_episode_of_a_reset_without_a_seed_has_no_seed(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    assert play(env, None)
    assert load(tmp_path / "own.h5")[0].seed is None
    assert replays(tmp_path / "own.h5") == 1


def test_recording_changes_nothing(tmp_path: Path) -> None:
    parameters: dict[str, Any] = {"obs_size": 32, "num_objects": 5}
    bare = gymnasium.make("BulletArm/CloseLoopObjectGrasping-v0", **parameters)
    env = RecordDemonstrations(
        gymnasium.make("BulletArm/CloseLoopObjectGrasping-v0", **parameters), tmp_path / "own.h5"
    )
    for number in range(3):
        seed = 1 if number == 0 else None
        first, second = (each.reset(seed=seed)[0] for each in (bare, env))
        np.testing.assert_array_equal(first["heightmap"], second["heightmap"])
        assert finish(bare) == finish(env)
    assert bare.unwrapped.get_state() == env.unwrapped.get_state()  # type: ignore[attr-defined]


def test_spec_makes_the_recorder_again(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    assert play(env, 0)
    assert env.spec is not None
    again = gymnasium.make(env.spec)
    assert isinstance(again, RecordDemonstrations) and len(again) == 1
    assert play(again, 1)
    assert [episode.seed for episode in load(tmp_path / "own.h5")] == [0, 1]


def test_step_after_the_end_is_refused(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(IDLE)
    assert play(env, 0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(IDLE)
    assert len(env) == len(load(tmp_path / "own.h5")) == 1


def test_file_of_other_parameters_is_refused_with_their_names(tmp_path: Path) -> None:
    path = tmp_path / "own.h5"
    play(record(path), 0)
    before = path.read_bytes()
    with pytest.raises(ValueError) as caught:
        record(path, obs_size=48, max_steps=9)
    must = "path must be a file of demonstrations with max_steps=9, obs_size=48, got "
    assert str(caught.value) == f"{must}{path} with max_steps=5, obs_size=32"
    other = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", **PARAMETERS)
    with pytest.raises(ValueError, match="env_id='BulletArm/CloseLoopBlockPicking-v0'"):
        RecordDemonstrations(other, path)
    with pytest.raises(ValueError, match=r"^env must be an environment of this package .*CartPole"):
        RecordDemonstrations(gymnasium.make("CartPole-v1"), path)  # type: ignore[arg-type]
    assert path.read_bytes() == before


OWN_TASK = """
from bulletarm_gym import register_task
from bulletarm_gym.tasks.picking import BlockReaching

class OwnReaching(BlockReaching):
    pass

register_task("OwnReaching", OwnReaching)
"""
COLLECT = """
from bulletarm_gym.demonstrations import collect
collect("own_tasks:BulletArm/CloseLoopOwnReaching-v0", 1, seed=0, env_kwargs={"obs_size": 32}, path="own.h5")
"""
REPLAY = """
import gymnasium
from bulletarm_gym.demonstrations import load, replay
found = load("own.h5")
env = found.make_env()
print(type(env.unwrapped.task).__name__, len(list(replay(found, 0, env.unwrapped))) == len(found[0]) + 1)
gymnasium.make("own_tasks:" + found.env_id)
"""


def test_file_of_an_own_task_replays_in_a_fresh_process(tmp_path: Path) -> None:
    (tmp_path / "own_tasks.py").write_text(OWN_TASK)
    for code in (COLLECT, REPLAY):
        command = [sys.executable, "-c", code]
        child = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert child.returncode == 0, child.stderr
    assert child.stdout.split() == ["OwnReaching", "True"]
