"""Learners on several tasks at once: demonstrations of each task in proportion, one policy."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from bulletarm_gym.vector import make_multi_task_vec
from sb3_extensions.sacfd import SACfD

IDS = [f"BulletArm/CloseLoop{task}-v0" for task in ("BlockReaching", "BlockPicking", "BlockPushing")]
SMALL = {"features_extractor_kwargs": {"n": 4, "channels": [2, 2, 2, 2, 2]}}


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
def test_demonstrations_come_from_each_task_in_proportion(kind: Any) -> None:
    vec_env = VecMonitor(make_multi_task_vec(IDS, 2 if kind is DummyVecEnv else 1, kind, obs_size=64))
    model = SACfD("EquivariantPolicy", vec_env, expert_episodes=6, policy_kwargs=SMALL, seed=0).learn(6)
    buffer: Any = model.replay_buffer
    table, rows = buffer.table, slice(0, buffer.table.n_pinned)
    ends = table.observations["task_id"][rows][~table.columns["valid"][rows]]  # an episode ends in such a row
    vec_env.close()
    np.testing.assert_array_equal(ends.sum(axis=0), [2, 2, 2])
    assert len(ends) == 6
