"""Samplers of the replay buffer: shares, priorities and importance weights."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.sampling import MIN_PRIORITY, PrioritizedSampler, ShareSampler

BATCH = 16


def make_buffer(n_expert: int, size: int = 400, **kwargs) -> ExpertReplayBuffer:
    """Return a buffer with expert episodes of one step, numbered from 0 by their observations."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    arguments = {"device": "cpu", "seed": 0, **kwargs}
    buffer = ExpertReplayBuffer(size, space, spaces.Box(-1, 1, (1,)), **arguments)
    for number in range(n_expert):
        observations = {"observation": np.full((2, 1), number)}
        buffer.add_episode(observations, np.zeros((1, 1)), np.ones(1), np.ones(1, bool))
    return buffer


def play(buffer: ExpertReplayBuffer, n_steps: int = 1, success: bool = False):
    """Add online episodes of one step."""
    for _ in range(n_steps):
        obs = np.full((1, 1), 1000 + buffer.size(), np.float32)
        info = {"is_success": success}
        buffer.add(obs, obs, np.zeros((1, 1)), np.full(1, float(success)), np.ones(1, bool), [info])


def shares(**kwargs) -> dict[str, Any]:
    return {"sampler": {"shares": kwargs}}


@pytest.mark.parametrize(("options", "first"), [({"balanced_from": 8}, 8), ({}, 1)])
def test_shares_apply_from_balanced_from_steps(options, first):
    """By default from the first online step."""
    divided = make_buffer(20, **shares(expert_fraction=0.5, **options))
    uniform = make_buffer(20)
    for online in range(1, 30):
        for buffer in (divided, uniform):
            play(buffer)
            buffer.seed(5)
        samples, others = divided.sample(BATCH), uniform.sample(BATCH)
        assert np.array_equal(samples.indices, others.indices) == (online < first)
        assert online < first or samples.is_expert.sum() == BATCH // 2


@pytest.mark.parametrize("successes, share", [(0, 0.0), (2, 0.05), (8, 0.2), (20, 0.4), (40, 0.4)])
def test_successes_are_sampled_at_most_as_often_as_expert_steps(successes, share):
    """Weights correct their share: the weighted mean over online steps is the mean over all online steps."""
    buffer = make_buffer(20, **shares(expert_fraction=0.5, success_fraction=0.4))
    play(buffer, successes, success=True)
    play(buffer, 80 - successes)
    samples = buffer.sample(20_000)
    online = ~samples.is_expert
    among_all = (1.0 - 0.5 - share) * successes / 80
    assert samples.is_expert.float().mean().item() == 0.5
    assert (samples.succeeded & online).float().mean().item() == pytest.approx(share + among_all, abs=0.01)
    assert (samples.weights[samples.is_expert] == 1).all()
    weights = samples.weights[online]
    total = (weights * samples.succeeded[online]).sum().item() / weights.sum().item()
    assert total == pytest.approx(successes / 80, rel=0.08)
    assert weights.mean().item() == pytest.approx(1.0, rel=0.03)


def prioritized(**kwargs) -> tuple[ExpertReplayBuffer, PrioritizedSampler]:
    """Return a buffer with four expert steps and six online steps."""
    buffer = make_buffer(4, sampler={"prioritized": kwargs})
    play(buffer, 6)
    assert isinstance(buffer.sampler, PrioritizedSampler)
    return buffer, buffer.sampler


def valid_rows(buffer: ExpertReplayBuffer) -> np.ndarray:
    return np.flatnonzero(buffer.table.columns["valid"])


@pytest.mark.parametrize("exponent", [0.0, 0.6])
@pytest.mark.parametrize(("progress_remaining", "beta"), [(1.0, 0.4), (0.25, 0.85), (0.0, 1.0)])
def test_probabilities_and_weights_follow_the_priorities(progress_remaining, beta, exponent):
    buffer, sampler = prioritized(exponent=exponent)
    rows, errors = valid_rows(buffer), np.linspace(-2, 3, 10)
    buffer.update_priorities(rows, th.as_tensor(abs(errors))[:, None])
    priorities = np.abs(errors) + MIN_PRIORITY
    priorities[:4] += 1
    probabilities = priorities**exponent / (priorities**exponent).sum()
    sampler.progress_remaining = progress_remaining
    samples = buffer.sample(100_000)
    counts = np.bincount(samples.indices, minlength=rows[-1] + 1)
    np.testing.assert_allclose(counts[rows] / 100_000, probabilities, atol=1e-4)
    assert counts.sum() == counts[rows].sum()
    weights = (10 * probabilities) ** -beta
    expected = (weights / weights.max())[np.searchsorted(rows, samples.indices)]
    np.testing.assert_allclose(samples.weights.numpy()[:, 0], expected, rtol=1e-5)


def test_a_new_step_gets_the_maximum_of_the_present_priorities():
    buffer, sampler = prioritized()
    rows = valid_rows(buffer)
    np.testing.assert_array_equal(sampler.masses[rows], 1.0)
    buffer.update_priorities(rows[-1:], th.tensor([[5.0]]))
    buffer.update_priorities(rows, th.full((10, 1), 0.2))
    play(buffer)
    new = valid_rows(buffer)[-1:]  # expert steps have a bonus
    np.testing.assert_allclose(sampler.masses[new] ** (1 / 0.6), 1.2 + MIN_PRIORITY)
    buffer.reset()
    assert not sampler.masses.any()
    play(buffer, 2)
    np.testing.assert_array_equal(sampler.masses[valid_rows(buffer)], [1, 1])


def test_only_valid_steps_have_a_priority():
    buffer = make_buffer(4, size=30, sampler="prioritized")
    rng = np.random.default_rng(0)
    assert isinstance(buffer.sampler, PrioritizedSampler)
    for _ in range(60):
        obs = rng.normal(size=(1, 1)).astype(np.float32)
        buffer.add(obs, obs + 1, np.zeros((1, 1)), np.zeros(1), rng.random(1) < 0.4, [{}])
        priorities = buffer.sampler.masses[np.arange(30)]
        np.testing.assert_array_equal(priorities > 0, buffer.table.columns["valid"])
        samples = buffer.sample(20)
        buffer.update_priorities(samples.indices, th.as_tensor(rng.random((20, 1))))


@pytest.mark.parametrize(
    ("sampler", "kwargs", "named"),
    [
        (ShareSampler, {"expert_fraction": 0.7, "success_fraction": 0.4}, r"got 0\.7 \+ 0\.4"),
        (ShareSampler, {"success_fraction": -0.1}, "success_fraction"),
        (ShareSampler, {"balanced_from": 0}, "balanced_from .* got 0"),
        (PrioritizedSampler, {"exponent": 1.5}, "exponent .* got 1.5"),
        (PrioritizedSampler, {"beta_start": -0.1}, "beta_start"),
        (PrioritizedSampler, {"expert_bonus": -1.0}, "expert_bonus .* got -1"),
    ],
)
def test_invalid_arguments_are_rejected(sampler, kwargs, named):
    with pytest.raises(ValueError, match=named):
        sampler(**kwargs)
