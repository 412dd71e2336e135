"""Where demonstrations come from, and the folder that keeps them."""

from __future__ import annotations

import importlib
import logging
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_extensions.demonstrations import source
from sb3_extensions.demonstrations.cache import EpisodeCache
from sb3_extensions.demonstrations.collecting import collect_episodes, make_expert_env
from sb3_extensions.demonstrations.source import DemonstrationSource
from sb3_extensions.replay.expert import ExpertReplayBuffer

OWN_TASK = """
import gymnasium as gym
import numpy as np


class OwnTask(gym.Env):
    metadata = {{"render_modes": ["rgb_array"]}}
    observation_space = gym.spaces.Dict({{"state": gym.spaces.Box(-1.0, 1.0, (1,), np.float32)}})
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return {{"state": np.zeros(1, np.float32)}}, {{}}

    def step(self, action):
        return {{"state": np.zeros(1, np.float32)}}, 1.0, True, False, {{"is_success": True}}

    def expert_action(self):
        return np.full(1, {speed}, np.float32)
"""


def fill(env: Any, seed: int | None = 0, **kwargs: Any) -> ExpertReplayBuffer:
    buffer = ExpertReplayBuffer(500, env.observation_space, env.action_space, gamma=0.9, seed=0)
    DemonstrationSource(**kwargs).fill(buffer, env, seed, rescale=lambda actions: actions)
    return buffer


def assert_equal_rows(first: ExpertReplayBuffer, second: ExpertReplayBuffer) -> None:
    assert first.expert_size == second.expert_size > 0
    for name, column in first.table.items():
        np.testing.assert_array_equal(column, second.table[name], err_msg=name)
    for key, frames in first.frames.data.items():
        np.testing.assert_array_equal(frames, second.frames.data[key], err_msg=key)


@pytest.fixture
def collections(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many episodes each collection was asked for."""
    asked: list[int] = []

    def spy(env: Any, episodes: int, *args: Any, **kwargs: Any) -> Any:
        asked.append(episodes)
        return collect_episodes(env, episodes, *args, **kwargs)

    monkeypatch.setattr(source, "collect_episodes", spy)
    return asked


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_kept_episodes_are_those_that_would_be_collected(
    noise: float, make_toy: Any, tmp_path: Path, collections: list[int]
) -> None:
    env = make_toy()
    first, second, without = (
        fill(env, episodes=4, noise=noise, cache=cache) for cache in (tmp_path, tmp_path, None)
    )
    assert collections == [4, 4]  # the second was not collected
    assert_equal_rows(first, second)
    assert_equal_rows(first, without)
    fewer = fill(env, episodes=2, noise=noise, cache=tmp_path)
    assert_equal_rows(fewer, fill(env, episodes=2, noise=noise))
    assert collections == [4, 4, 2]
    assert_equal_rows(fill(env, episodes=6, noise=noise, cache=tmp_path), fill(env, episodes=6, noise=noise))
    assert collections == [4, 4, 2, 6, 6]  # more than were kept: all anew
    assert len(list(tmp_path.iterdir())) == 1


def test_episodes_are_kept_by_what_they_depend_on(
    make_toy: Any, tmp_path: Path, collections: list[int]
) -> None:
    for arguments in ({}, {"noise": 0.05}, {"seed": 1}, {}):
        fill(make_toy(), episodes=2, cache=tmp_path, **arguments)  # type: ignore[arg-type]
    fill(make_toy(max_steps=9), episodes=2, cache=tmp_path)
    fill(make_toy(3, seed=5), episodes=2, cache=tmp_path)  # the number of environments does not matter
    assert len(collections) == 4
    assert len(list(tmp_path.iterdir())) == 4
    fill(make_toy(), None, episodes=2, cache=tmp_path)  # drawn episodes are not kept
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "foreign"])
def test_a_damaged_file_is_collected_again(
    damage: str, make_toy: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    expected = fill(make_toy(), episodes=3, cache=tmp_path)
    [file] = tmp_path.iterdir()
    content = bytearray(file.read_bytes())
    content[200] ^= 0xFF
    damaged = {"cut": content[:300], "flipped": content, "empty": b"", "foreign": b"no archive"}[damage]
    file.write_bytes(bytes(damaged))
    with caplog.at_level(logging.WARNING):
        assert_equal_rows(fill(make_toy(), episodes=3, cache=tmp_path), expected)
    assert f"{file} cannot be read" in caplog.text
    caplog.clear()
    assert_equal_rows(fill(make_toy(), episodes=3, cache=tmp_path), expected)
    assert not caplog.text


def test_a_change_of_the_environments_source_collects_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = tmp_path / "own_task.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    gym.register("OwnTask-v0", entry_point="own_task:OwnTask")
    speeds = []
    try:
        for speed in (0.5, 0.5, 0.25):
            module.write_text(OWN_TASK.format(speed=speed))
            sys.modules.pop("own_task", None)
            importlib.invalidate_caches()
            env = make_vec_env("OwnTask-v0", 1, seed=0)
            buffer = fill(env, episodes=1, cache=tmp_path / "cache")
            speeds.append(np.abs(buffer.table["action"][0]).max())
    finally:
        gym.registry.pop("OwnTask-v0")
        sys.modules.pop("own_task", None)
    np.testing.assert_allclose(speeds, [0.5, 0.5, 0.25])
    assert len(list((tmp_path / "cache").iterdir())) == 2


@pytest.mark.parametrize("data", ["own.h5", Path("own.h5"), 3])
def test_what_is_no_episodes_is_refused(data: Any) -> None:
    with pytest.raises(
        ValueError, match="expert_data must be episodes, read from a file where they are in one"
    ):
        DemonstrationSource(data=data)


def test_a_failed_save_leaves_nothing(make_toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise OSError("no space left on device")

    episodes = list(collect_episodes(make_expert_env(make_toy()), 1, 0, progress_bar=False))
    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="no space"):
        EpisodeCache(tmp_path / "new").save({}, episodes)
    assert not list((tmp_path / "new").iterdir())


def test_scenes_that_go_on_have_no_seed(
    make_toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_expert_env(make_toy())
    monkeypatch.setattr(type(env.unwrapped), "keeps_scene", True, raising=False)
    episodes = list(collect_episodes(env, 2, 0, progress_bar=False))
    cache = EpisodeCache(tmp_path)
    cache.save({}, episodes)
    kept = cache.load({}, 2)
    assert kept is not None
    assert [episode.seed for episode in kept] == [episodes[0].seed, None]


def test_episodes_handed_over_win(make_toy: Any, collections: list[int]) -> None:
    env = make_toy()
    given = list(collect_episodes(make_expert_env(env), 2, 3, progress_bar=False))
    plain = [SimpleNamespace(**{name: getattr(episode, name) for name in EPISODE_PARTS}) for episode in given]
    assert_equal_rows(fill(env, data=iter(plain)), fill(env, data=given))
    assert not collections


EPISODE_PARTS = ("observations", "actions", "rewards", "terminations")


def test_what_is_wanted_is_imitated_and_what_was_done_is_valued(make_toy: Any) -> None:
    buffer = fill(make_toy(), episodes=5, noise=0.05)
    rows = slice(buffer.expert_size)
    assert np.abs(buffer.table["action"][rows] - buffer.table["expert_action"][rows]).max() > 0.02


def test_emptiness() -> None:
    assert DemonstrationSource(0).is_empty
    assert not DemonstrationSource(1).is_empty
    assert not DemonstrationSource(0, data=[]).is_empty


@pytest.mark.parametrize(
    ("kwargs", "message"), [({"episodes": -1}, "expert_episodes"), ({"noise": -0.5}, "expert_noise")]
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"{message} must not be negative, got"):
        DemonstrationSource(**kwargs)
