"""Samplers of the replay buffer: shares, priorities and importance weights."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.replay.buffer import EXPLORED, ExpertReplayBuffer
from sb3_extensions.replay.sampling import MIN_PRIORITY, PrioritizedSampler, ShareSampler
from sb3_extensions.sacfd import SACfD

BATCH = 16


def make_buffer(n_expert: int, size: int = 400, **kwargs: Any) -> ExpertReplayBuffer:
    """Return a buffer with expert episodes of one step, numbered from 0 by their observations."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    arguments = {"device": "cpu", "seed": 0, **kwargs}
    buffer = ExpertReplayBuffer(size, space, spaces.Box(-1, 1, (1,)), **arguments)
    for number in range(n_expert):
        observations = {"observation": np.full((2, 1), number)}
        buffer.add_episode(observations, np.zeros((1, 1)), np.ones(1), np.ones(1, bool))
    return buffer


def play(buffer: ExpertReplayBuffer, n_steps: int = 1, success: bool = False, explored: bool = False) -> None:
    """Add online episodes of one step."""
    for _ in range(n_steps):
        obs = np.full((1, 1), 1000 + buffer.size(), np.float32)
        info = {"is_success": success, EXPLORED: explored}
        buffer.add(obs, obs, np.zeros((1, 1)), np.full(1, float(success)), np.ones(1, bool), [info])


def shares(**kwargs: Any) -> dict[str, Any]:
    return {"sampler": {"shares": kwargs}}


def test_shares_apply_from_balanced_from_steps() -> None:
    divided = make_buffer(20, **shares(expert_fraction=0.5, balanced_from=8))
    uniform = make_buffer(20)
    for online in range(30):
        for buffer in (divided, uniform):
            buffer.seed(5)
        samples, others = divided.sample(BATCH), uniform.sample(BATCH)
        assert np.array_equal(samples.indices, others.indices) == (online < 8)
        assert online < 8 or samples.is_expert.sum() == BATCH // 2
        play(divided)
        play(uniform)


def test_shares_apply_from_the_first_online_step_by_default() -> None:
    buffer = make_buffer(10, sampler="shares")
    assert buffer.sample(BATCH).is_expert.all()
    play(buffer)
    assert buffer.sample(BATCH).is_expert.sum() == BATCH // 2


@pytest.mark.parametrize("successes, share", [(0, 0.0), (2, 0.05), (8, 0.2), (20, 0.4), (40, 0.4)])
def test_successes_are_sampled_at_most_as_often_as_expert_steps(successes: int, share: float) -> None:
    buffer = make_buffer(20, **shares(expert_fraction=0.5, success_fraction=0.4))
    play(buffer, successes, success=True)
    play(buffer, 80 - successes)
    samples = buffer.sample(20_000)
    among_all = (1.0 - 0.5 - share) * successes / 80
    assert samples.is_expert.float().mean().item() == 0.5
    succeeded = (samples.succeeded & ~samples.is_expert).float().mean().item()
    assert succeeded == pytest.approx(share + among_all, abs=0.01)


@pytest.mark.parametrize("successes", [1, 5, 40])
def test_weights_correct_the_share_of_successes(successes: int) -> None:
    """The weighted mean over the online steps of many batches is the mean over all online steps."""
    buffer = make_buffer(20, **shares(expert_fraction=0.5, success_fraction=0.3))
    play(buffer, successes, success=True)
    play(buffer, 60 - successes)
    totals = np.zeros(2)
    for _ in range(3000):
        samples = buffer.sample(BATCH)
        online = ~samples.is_expert
        weights = samples.weights[online]
        totals += [(weights * samples.succeeded[online]).sum().item(), weights.sum().item()]
        assert (samples.weights[samples.is_expert] == 1).all()
    assert totals[0] / totals[1] == pytest.approx(successes / 60, rel=0.06)
    assert totals[1] / (3000 * BATCH / 2) == pytest.approx(1.0, rel=0.02)


def test_an_exploratory_step_of_a_success_counts_as_success() -> None:
    """The episode succeeded without a later exploratory action."""
    buffer = make_buffer(1, **shares(expert_fraction=0.5, success_fraction=0.5))
    play(buffer, 1, success=True, explored=True)
    assert buffer.sample(20).succeeded.all()


def prioritized(**kwargs: Any) -> tuple[ExpertReplayBuffer, PrioritizedSampler]:
    """Return a buffer with four expert steps and six online steps."""
    buffer = make_buffer(4, sampler={"prioritized": kwargs})
    play(buffer, 6)
    assert isinstance(buffer.sampler, PrioritizedSampler)
    return buffer, buffer.sampler


def valid_rows(buffer: ExpertReplayBuffer) -> np.ndarray:
    return np.flatnonzero(buffer.table.columns["valid"])


@pytest.mark.parametrize("progress_remaining", [1.0, 0.25, 0.0])
def test_probabilities_and_weights_follow_the_priorities(progress_remaining: float) -> None:
    buffer, sampler = prioritized()
    rows, errors = valid_rows(buffer), np.linspace(-2, 3, 10)
    buffer.update_priorities(rows, th.as_tensor(abs(errors))[:, None])
    priorities = np.abs(errors) + MIN_PRIORITY
    priorities[:4] += 1
    probabilities = priorities**0.6 / (priorities**0.6).sum()
    sampler.progress_remaining = progress_remaining
    samples = buffer.sample(100_000)
    counts = np.bincount(samples.indices, minlength=rows[-1] + 1)
    np.testing.assert_allclose(counts[rows] / 100_000, probabilities, atol=1e-4)
    assert counts.sum() == counts[rows].sum()
    beta = {1.0: 0.4, 0.25: 0.85, 0.0: 1.0}[progress_remaining]
    weights = (10 * probabilities) ** -beta
    expected = (weights / weights.max())[np.searchsorted(rows, samples.indices)]
    np.testing.assert_allclose(samples.weights.numpy()[:, 0], expected, rtol=1e-5)


def test_exponent_0_samples_uniformly() -> None:
    buffer, _ = prioritized(exponent=0.0)
    buffer.update_priorities(valid_rows(buffer), th.arange(10.0)[:, None])
    samples = buffer.sample(10_000)
    np.testing.assert_array_equal(np.unique(samples.indices, return_counts=True)[1], 1000)
    assert (samples.weights == 1).all()


def test_a_new_step_gets_the_maximum_of_the_present_priorities() -> None:
    buffer, sampler = prioritized()
    rows = valid_rows(buffer)
    np.testing.assert_array_equal(sampler.masses[rows], 1.0)
    buffer.update_priorities(rows[-1:], th.tensor([[5.0]]))
    buffer.update_priorities(rows, th.full((10, 1), 0.2))
    play(buffer)
    new = valid_rows(buffer)[-1:]
    np.testing.assert_allclose(
        sampler.masses[new] ** (1 / 0.6), 1.2 + MIN_PRIORITY
    )  # expert steps have a bonus


def test_only_valid_steps_have_a_priority() -> None:
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


def test_reset_removes_priorities() -> None:
    buffer, sampler = prioritized()
    buffer.update_priorities(valid_rows(buffer), th.full((10, 1), 9.0))
    buffer.reset()
    assert not sampler.masses.any()
    play(buffer, 2)
    np.testing.assert_array_equal(sampler.masses[valid_rows(buffer)], [1, 1])


@pytest.mark.parametrize("n_steps", [1, 3])
def test_sacfd_updates_the_priorities(n_steps: int, make_toy: Any) -> None:
    model = SACfD(
        "MultiInputPolicy",
        make_toy(),
        replay_buffer_kwargs={"sampler": "prioritized"},
        n_steps=n_steps,
        ent_coef=0.0,
        gamma=0.9,
        expert_episodes=3,
        policy_kwargs={"features_extractor_kwargs": {"channels": [4, 8, 8]}},
        seed=0,
        device="cpu",
    )
    model.learn(20)
    buffer = model.replay_buffer
    assert buffer is not None and isinstance(buffer.sampler, PrioritizedSampler)
    assert buffer.sampler.progress_remaining == model._current_progress_remaining == 0
    samples = buffer.sample(8)
    samples = samples._replace(dones=th.ones_like(samples.dones))
    buffer.sample = lambda *args, **kwargs: samples  # type: ignore[method-assign]
    with th.no_grad():
        values = model.critic(samples.observations, samples.actions)
        errors = sum((value - samples.rewards).abs() for value in values) / 2
    model.train(1, 8)
    pairs = zip(samples.indices, errors[:, 0].tolist(), samples.is_expert[:, 0].tolist(), strict=True)
    expected = {row: error + expert + MIN_PRIORITY for row, error, expert in pairs}
    stored = buffer.sampler.masses[np.array(list(expected))] ** (1 / 0.6)
    np.testing.assert_allclose(stored, list(expected.values()), rtol=1e-4)


@pytest.mark.parametrize(
    ("sampler", "kwargs", "message"),
    [
        (ShareSampler, {"expert_fraction": 0.7, "success_fraction": 0.4}, r"at most 1, got 0\.7 \+ 0\.4"),
        (ShareSampler, {"success_fraction": -0.1}, "success_fraction must be between 0 and 1"),
        (ShareSampler, {"balanced_from": 0}, "balanced_from must be positive, got 0"),
        (PrioritizedSampler, {"exponent": 1.5}, "exponent must be between 0 and 1, got 1.5"),
        (PrioritizedSampler, {"beta_start": -0.1}, "beta_start"),
        (PrioritizedSampler, {"expert_bonus": -1.0}, "expert_bonus must not be negative, got -1"),
    ],
)
def test_bad_arguments(sampler: Any, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sampler(**kwargs)
