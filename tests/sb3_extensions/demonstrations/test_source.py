"""Demonstrations of an expert, and those that are passed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_extensions.demonstrations import source
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.demonstrations.source import DemonstrationSource, load_episodes
from sb3_extensions.replay.buffer import ExpertReplayBuffer


def fill(env: Any, seed: int | None = 0, **kwargs: Any) -> ExpertReplayBuffer:
    buffer = ExpertReplayBuffer(500, env.observation_space, env.action_space, gamma=0.9, seed=0)
    DemonstrationSource(**kwargs).fill(buffer, env, seed, rescale=lambda actions: actions)
    return buffer


def assert_equal_rows(first: ExpertReplayBuffer, second: ExpertReplayBuffer) -> None:
    assert first.expert_size == second.expert_size > 0
    for name in ("action", "expert_action", "reward", "done"):
        np.testing.assert_array_equal(first.steps(name), second.steps(name), err_msg=name)
    for key, images in first.table.observations.items():
        np.testing.assert_array_equal(images, second.table.observations[key], err_msg=key)


@pytest.fixture
def collections(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many episodes each collection was asked for."""
    asked: list[int] = []

    def spy(env: Any, episodes: int, *args: Any, **kwargs: Any) -> Any:
        asked.append(episodes)
        return collect_episodes(env, episodes, *args, **kwargs)

    monkeypatch.setattr(source, "collect_episodes", spy)
    return asked


def test_expert_data_must_be_episodes_or_a_path() -> None:
    with pytest.raises(ValueError, match=r"expert_data must be an iterable of episodes or the path .* got 3"):
        load_episodes(3)  # type: ignore[arg-type]


@pytest.mark.parametrize("data", [[], iter([])])
def test_demonstrations_without_an_episode_are_refused(data: Any, make_toy: Any) -> None:
    with pytest.raises(ValueError, match="expert_data must have at least one episode, got none"):
        fill(make_toy(), data=data)


def test_episodes_handed_over_win(make_toy: Any, collections: list[int]) -> None:
    env = make_toy()
    given = list(collect_episodes(make_expert_envs(env)[0][0], 2, 3, progress_bar=False))
    plain = [SimpleNamespace(**{name: getattr(episode, name) for name in EPISODE_PARTS}) for episode in given]
    assert_equal_rows(fill(env, data=iter(plain)), fill(env, data=given))
    assert not collections


EPISODE_PARTS = ("observations", "actions", "rewards", "terminations")


def test_what_is_wanted_is_imitated_and_what_was_done_is_valued(make_toy: Any) -> None:
    buffer = fill(make_toy(), episodes=5, noise=0.05)
    assert np.abs(buffer.steps("action") - buffer.steps("expert_action")).max() > 0.02


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
