"""When samples are divided between the expert and the agent."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from sb3_extensions.replay.expert import ExpertReplayBuffer

BATCH = 16


def make_buffer(n_expert: int, **kwargs: Any) -> ExpertReplayBuffer:
    """So many transitions of the expert, each an episode of its own."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    arguments = {"frames_per_transition": 2, "device": "cpu", "seed": 0, **kwargs}
    buffer = ExpertReplayBuffer(200, space, spaces.Box(-1, 1, (1,)), **arguments)
    for _ in range(n_expert):
        buffer.add_episode({"observation": np.zeros((2, 1))}, np.zeros((1, 1)), np.ones(1), np.ones(1, bool))
    return buffer


def play(buffer: ExpertReplayBuffer, n_steps: int = 1) -> None:
    """Transitions of the agent."""
    for _ in range(n_steps):
        obs = np.ones((1, 1), np.float32)
        buffer.add(obs, obs, np.zeros((1, 1)), np.zeros(1), np.zeros(1, bool), [{}])


def draw(buffer: ExpertReplayBuffer) -> Any:
    buffer.seed(5)
    return buffer.sample(BATCH)


def test_samples_are_divided_once_both_sides_have_enough() -> None:
    shared, alike = make_buffer(20, expert_fraction=0.5, balanced_from=8), make_buffer(20)
    for own in range(30):
        samples, uniform = draw(shared), draw(alike)
        assert np.array_equal(samples.indices, uniform.indices) == (own < 8)
        assert own < 8 or samples.is_expert.sum() == BATCH // 2
        play(shared)
        play(alike)


@pytest.mark.parametrize("wins, share", [(0, 0.0), (2, 0.05), (8, 0.2), (20, 0.4), (40, 0.4)])
def test_a_success_comes_up_as_often_as_an_expert_transition_at_most(wins: int, share: float) -> None:
    """Of 20 of the expert's, which are half of each batch."""
    buffer = make_buffer(20, expert_fraction=0.5, success_fraction=0.4, gamma=0.99)
    obs = np.ones((1, 1), np.float32)
    for own in range(80):
        won = own < wins
        buffer.add(obs, obs, np.zeros((1, 1)), np.full(1, float(won)), np.ones(1, bool), [{}])
    samples = buffer.sample(20_000)
    own_share = (1.0 - 0.5 - share) * wins / 80  # those that come up among all of the agent's
    assert samples.is_expert.float().mean().item() == 0.5
    succeeded = ((samples.returns > 0) & ~samples.is_expert).float().mean().item()
    assert succeeded == pytest.approx(share + own_share, abs=0.01)


def test_shares_of_successes_are_right_on_the_mean_of_small_batches() -> None:
    buffer = make_buffer(20, expert_fraction=0.5, success_fraction=0.4, gamma=0.99)
    obs = np.ones((1, 1), np.float32)
    buffer.add(obs, obs, np.zeros((1, 1)), np.ones(1), np.ones(1, bool), [{}])
    for _ in range(99):
        buffer.add(obs, obs, np.zeros((1, 1)), np.zeros(1), np.ones(1, bool), [{}])
    won = [((s.returns > 0) & ~s.is_expert).sum().item() for s in (buffer.sample(8) for _ in range(4000))]
    assert np.mean(won) == pytest.approx(8 * 0.5 / 20 + 3.8 / 100, abs=0.03)  # and among all of the agent's


def test_until_the_expert_has_enough_rows_all_are_drawn_alike() -> None:
    buffer = make_buffer(7, expert_fraction=0.5, balanced_from=8)
    play(buffer, 63)
    assert buffer.sample(20_000).is_expert.float().mean().item() == pytest.approx(0.1, abs=0.01)


def test_by_default_samples_are_divided_from_the_first_transition() -> None:
    default, explicit = (
        make_buffer(10, expert_fraction=0.25, **given) for given in ({}, {"balanced_from": 1})
    )
    for buffer in (default, explicit):
        assert draw(buffer).is_expert.all()  # the agent has nothing yet
        play(buffer)
        assert draw(buffer).is_expert.sum() == BATCH // 4
    np.testing.assert_array_equal(draw(default).indices, draw(explicit).indices)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"expert_fraction": 0.5, "balanced_from": 0}, "balanced_from must be at least 1, got 0"),
        ({"balanced_from": 8}, "balanced_from=8 needs an expert_fraction"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(0, **kwargs)
