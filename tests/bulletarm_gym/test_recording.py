"""Whoever acts can be recorded, into files like those of the experts."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from bulletarm_gym.demonstrations import RecordDemonstrations, collect, load

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
PARAMETERS: dict[str, Any] = {"obs_size": 32, "max_steps": 5}


def record(path: Path, **parameters: Any) -> RecordDemonstrations:
    return RecordDemonstrations(gymnasium.make(ENV_ID, **{**PARAMETERS, **parameters}), path)


def play(env: RecordDemonstrations, seed: int | None, by_expert: bool = True) -> bool:
    _, info = env.reset(seed=seed)
    over = False
    while not over:
        idle = np.array([1, 0, 0, 0, 0], np.float32)
        action = env.get_wrapper_attr("expert_action")() if by_expert else idle
        _, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    return bool(info["is_success"])


def test_an_expert_recorded_is_an_expert_collected(tmp_path: Path) -> None:
    collected = collect(ENV_ID, 1, seed=0, env_kwargs=PARAMETERS)
    assert play(record(tmp_path / "own.h5"), collected[0].seed)
    recorded = load(tmp_path / "own.h5")
    assert recorded.about["planner"] == "human"
    assert {**recorded.about, "planner": "", "seed": 0} == {**collected.about, "planner": "", "seed": 0}
    for name, values in vars(collected[0]).items():
        np.testing.assert_equal(getattr(recorded[0], name), values)


def test_failures_count_and_are_not_kept(tmp_path: Path) -> None:
    env = record(tmp_path / "own.h5")
    assert not play(env, 1, by_expert=False)
    assert len(env) == 0 and not (tmp_path / "own.h5").exists()
    assert play(env, 2)
    found = load(tmp_path / "own.h5")
    assert (len(found), found.attempts, found[0].seed) == (1, 2, 2)


def test_a_file_grows(tmp_path: Path) -> None:
    for seed in (3, 4):
        play(record(tmp_path / "own.h5"), seed)
    assert [episode.seed for episode in load(tmp_path / "own.h5")] == [3, 4]


def test_a_drawn_seed_is_told(tmp_path: Path) -> None:
    play(record(tmp_path / "own.h5"), None)
    episode = load(tmp_path / "own.h5")[0]
    observation, _ = gymnasium.make(ENV_ID, **PARAMETERS).reset(seed=episode.seed)
    np.testing.assert_allclose(episode.observations["heightmap"][0], observation["heightmap"], atol=1e-4)


def test_files_of_other_environments_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "own.h5"
    play(record(path), 0)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"path: .* has configuration="):
        record(path, obs_size=48)
    with pytest.raises(ValueError, match=r"env: got .*CartPole"):
        RecordDemonstrations(gymnasium.make("CartPole-v1"), path)  # type: ignore[arg-type]
    assert path.read_bytes() == before
