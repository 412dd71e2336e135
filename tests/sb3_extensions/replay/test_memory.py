"""What a replay buffer takes, and what it says about it."""

import logging
import re
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_extensions.replay.expert import ExpertReplayBuffer
from sb3_extensions.replay.prioritized import PrioritizedReplayBuffer

SIZE = 300  # transitions


def test_memory_of_the_paper_preset(caplog: pytest.LogCaptureFixture) -> None:
    space = spaces.Dict(
        {
            "heightmap": spaces.Box(0.0, 0.4, (1, 128, 128), np.float32),
            "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
    )
    buffer = ExpertReplayBuffer(100_000, space, spaces.Box(-1, 1, (5,), np.float32), device="cpu", n_envs=5)
    assert not buffer.table and not buffer.frames.data  # nothing before the first add
    obs = {key: np.zeros((5, *value.shape), np.float32) for key, value in space.items()}
    with caplog.at_level(logging.INFO):
        for _ in range(3):
            buffer.add(obs, obs, np.zeros((5, 5)), np.zeros(5), np.zeros(5, bool), [{}] * 5)
    size = sum(array.nbytes for array in (*buffer.table.values(), *buffer.frames.data.values()))
    assert size < 1.8e9
    messages = [record.message for record in caplog.records if "Replay buffer" in record.message]
    assert len(messages) == 1
    assert f"{size / 1e9:.2f} GB" in messages[0]


@pytest.mark.parametrize("cls", [ExpertReplayBuffer, PrioritizedReplayBuffer])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(
    ("length", "kwargs", "kept"),
    [(1, {}, 0.545), (1, {"frames_per_transition": 2}, 1.0), (5, {}, 0.91), (12, {}, 1.0)],
)
def test_transitions_dropped_for_want_of_frames_are_told_once(
    cls: type, n_envs: int, length: int, kwargs: dict[str, Any], kept: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Episodes of one length: as many transitions are kept as have their frames."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    buffer = cls(SIZE, space, spaces.Box(-1, 1, (1,)), device="cpu", n_envs=n_envs, **kwargs)
    for k in range(4 * SIZE // n_envs):
        obs = np.full((n_envs, 1), k, np.float32)
        done = np.full(n_envs, (k + 1) % length == 0)
        next_obs = obs + np.where(done, 0.5, 1.0).astype(np.float32)[:, None]
        buffer.add(obs, next_obs, np.zeros((n_envs, 1)), np.zeros(n_envs), done, [{}] * n_envs)
    assert buffer.size() == pytest.approx(kept * SIZE, abs=0 if kept == 1 else 4 * n_envs)
    warnings = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == (kept < 1)
    for warning in warnings:
        told, wanted, needed = re.findall(r"\d+(?:\.\d+)?", warning)[:3]
        assert int(told) == pytest.approx(buffer.size(), abs=4 * n_envs) and int(wanted) == SIZE
        assert float(needed) == pytest.approx((length + 1) / length, abs=0.02)
        assert "frames_per_transition=2 is always enough" in warning
