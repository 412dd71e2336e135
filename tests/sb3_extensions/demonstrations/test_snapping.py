"""Demonstrations whose executed actions are on a grid."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_extensions.demonstrations.action_transforms import GridSnapping
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.demonstrations.source import DemonstrationSource
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec

CODEC = SpatialActionCodec(24, "pxyr", num_rotations=4)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (4,), np.float32),
        spaces.Box(np.array([0.0, 2.0, -3.0, 0.0]), np.array([1.0, 2.4, 5.0, 3.2]), dtype=np.float64),
    ],
)
def test_nearest_actions_in_the_units_of_the_environment(space: Any) -> None:
    transform, rng = GridSnapping(space, CODEC), np.random.default_rng(0)
    space.seed(0)
    for _ in range(50):
        wanted = space.sample()
        done = transform(wanted, rng)
        assert space.contains(done) and done.dtype == space.dtype
        share = (wanted - space.low) / (space.high - space.low)
        expected = CODEC.snap(2 * share[None] - 1)[0]
        np.testing.assert_allclose(2 * (done - space.low) / (space.high - space.low) - 1, expected, atol=1e-6)
        np.testing.assert_allclose(transform(done, rng), done, atol=1e-6)
    beyond = transform(space.high + 1, rng)
    np.testing.assert_array_equal(beyond, transform(space.high, rng))


def test_expert_continues_from_the_snapped_action(make_picking: Any) -> None:
    """Episodes have executed and intended actions. Only successes of the executed actions are kept."""
    [(env, _)] = make_expert_envs(make_picking(size=24, max_steps=2))
    few = SpatialActionCodec(24, "pxyr", num_rotations=2)  # too few to grip some bars
    transform = GridSnapping(env.action_space, few)
    episodes = list(collect_episodes(env, 8, seed=0, action_transform=transform, progress_bar=False))
    freely = list(collect_episodes(env, 8, seed=0, progress_bar=False))
    assert [episode.seed for episode in episodes] != [episode.seed for episode in freely]  # some failed
    for episode in episodes:
        np.testing.assert_array_equal(few.snap(episode.actions), episode.actions)
        np.testing.assert_array_equal(few.snap(episode.expert_actions), episode.actions)
        assert (episode.expert_actions[:, 1:3] != episode.actions[:, 1:3]).all()
        assert episode.rewards.tolist() == [0.0, 1.0] and episode.terminations[-1]
        # The in-hand image is of the place on the grid
        env.seed(episode.seed)
        env.reset()
        observed = env.step(episode.actions[:1])[0]
        np.testing.assert_array_equal(observed["in_hand"][0], episode.observations["in_hand"][1])


def test_source_snaps_executed_actions(make_picking: Any) -> None:
    env = make_picking(size=24)
    buffers = []
    for snap in (None, CODEC):
        buffer = ExpertReplayBuffer(100, env.observation_space, env.action_space, gamma=0.9, seed=0)
        DemonstrationSource(5, snap=snap).fill(buffer, env, 0, rescale=lambda actions: actions)
        buffers.append(buffer.steps("action")[: buffer.expert_size])
    free, snapped = buffers
    np.testing.assert_array_equal(CODEC.snap(snapped), snapped)
    assert not np.array_equal(CODEC.snap(free), free)
