"""Prioritized replay, against slow references."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.replay.prioritized import MIN_PRIORITY, PrioritizedReplayBuffer, SumTree
from sb3_extensions.sacfd import SACfD

SPACE = spaces.Box(-1e6, 1e6, (1,), np.float32)
EXPERTS = 4


def make_buffer(
    size: int = 20, steps: int = 6, p_done: float = 0.0, **kwargs: Any
) -> PrioritizedReplayBuffer:
    """Four expert transitions and ``steps`` others, numbered from 100 by their observations."""
    buffer = PrioritizedReplayBuffer(size, SPACE, spaces.Box(-1, 1, (1,)), device="cpu", seed=0, **kwargs)
    numbers = np.arange(EXPERTS + 1, dtype=np.float32)[:, None]
    ends = np.arange(EXPERTS) == EXPERTS - 1
    buffer.add_episode({"observation": numbers}, np.zeros((EXPERTS, 1)), np.ones(EXPERTS), ends)
    play(buffer, range(100, 106))
    return buffer


def play(buffer: PrioritizedReplayBuffer, numbers: range, p_done: float = 0.0) -> None:
    rng = np.random.default_rng(numbers.start)
    for k in numbers:
        done = rng.random(1) < p_done
        obs = np.array([[k]], dtype=np.float32)
        next_obs = obs + np.where(done, 0.5, 1).astype(np.float32)
        buffer.add(obs, next_obs, np.zeros((1, 1)), np.full(1, k, np.float32), done, [{}])


@pytest.mark.parametrize("capacity", [1, 2, 5, 8, 100])
def test_sum_tree_equals_cumulative_sums(capacity: int) -> None:
    rng = np.random.default_rng(capacity)
    tree, values = SumTree(capacity), np.zeros(capacity)
    for _ in range(20):
        leaves = rng.permutation(capacity)[: rng.integers(1, capacity + 1)]
        values[leaves] = rng.random(len(leaves)) * (rng.random(len(leaves)) < 0.7)
        tree[leaves] = values[leaves]
        np.testing.assert_array_equal(tree[np.arange(capacity)], values)
        np.testing.assert_allclose(tree.total, values.sum())
        if not values.any():
            continue
        masses = rng.random(200) * tree.total * (1 - 1e-9)
        np.testing.assert_array_equal(
            tree.find(masses), np.searchsorted(np.cumsum(values), masses, side="right")
        )
        found = tree.find(np.array([0.0, tree.total, tree.total * (1 + 1e-9)]))
        assert (values[found] > 0).all()
        assert found[1] == found[2] == np.flatnonzero(values)[-1]


@pytest.mark.parametrize("progress_remaining", [1.0, 0.25, 0.0])
def test_draws_and_weights_follow_the_priorities(progress_remaining: float) -> None:
    buffer = make_buffer()
    errors = np.linspace(-2, 3, 10)
    buffer.update_priorities(np.arange(10), th.as_tensor(errors)[:, None])
    priorities = np.abs(errors) + 1e-6
    priorities[:EXPERTS] += 1
    probabilities = priorities**0.6 / (priorities**0.6).sum()
    buffer.progress_remaining = progress_remaining
    samples = buffer.sample(100_000)
    shares = np.bincount(samples.indices, minlength=20) / 100_000
    np.testing.assert_allclose(shares[:10], probabilities, atol=1e-4)  # finer than independent draws
    assert not shares[10:].any()
    beta = {1.0: 0.4, 0.25: 0.85, 0.0: 1.0}[progress_remaining]
    weights = (10 * probabilities) ** -beta
    np.testing.assert_allclose(
        samples.weights.numpy()[:, 0], (weights / weights.max())[samples.indices], rtol=1e-5
    )


def test_without_exponent_it_is_uniform() -> None:
    buffer = make_buffer(exponent=0.0)
    buffer.update_priorities(np.arange(10), th.arange(10.0)[:, None])
    samples = buffer.sample(10_000)
    np.testing.assert_array_equal(np.bincount(samples.indices), 1000)
    assert (samples.weights == 1).all()


def test_new_transitions_get_the_greatest_priority_of_now() -> None:
    buffer = make_buffer()
    np.testing.assert_array_equal(buffer.tree[np.arange(11)], [1.0] * 10 + [0.0])
    buffer.update_priorities(np.array([7]), th.tensor([[5.0]]))
    play(buffer, range(106, 107))
    buffer.update_priorities(np.array([7, 10]), th.tensor([[0.0], [3.0]]))  # a wild error is made good
    play(buffer, range(107, 108))
    priorities = buffer.tree[np.array([7, 10, 11])] ** (1 / 0.6)
    np.testing.assert_allclose(priorities, [1e-6, 3 + MIN_PRIORITY, 3 + MIN_PRIORITY])
    buffer.update_priorities(np.arange(12), th.full((12, 1), 0.2))
    play(buffer, range(108, 109))  # the expert's four have their bonus
    np.testing.assert_allclose(buffer.tree[np.array([12])] ** (1 / 0.6), 1.2 + MIN_PRIORITY)


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("p_done", [0.0, 0.95])  # the second drops transitions whose frames are overwritten
def test_only_kept_transitions_have_a_priority(p_done: float, n_steps: int) -> None:
    buffer = make_buffer(n_steps=n_steps, gamma=0.9)
    rng = np.random.default_rng(0)
    for start in range(106, 206, 5):
        play(buffer, range(start, start + 5), p_done)
        kept = np.zeros(20, dtype=bool)
        kept[buffer.rows.slots(buffer.rows.ids(np.arange(buffer.size())))] = True
        np.testing.assert_array_equal(buffer.tree[np.arange(20)] > 0, kept)
        samples = buffer.sample(400)
        numbers = samples.observations.numpy()[:, 0]
        assert set(numbers[numbers >= 100]) == set(range(start + 5 - buffer.size() + EXPERTS, start + 5))
        np.testing.assert_array_equal(samples.is_expert.numpy()[:, 0], numbers < 100)
        assert set(numbers[numbers < 100]) == set(range(EXPERTS))
        buffer.update_priorities(samples.indices, th.as_tensor(rng.random((400, 1))))
    assert (buffer.size() < 20) == (p_done > 0.5)


def test_late_errors_do_not_revive_a_dropped_transition() -> None:
    buffer = make_buffer()
    buffer.update_priorities(np.array([15]), th.tensor([[3.0]]))
    assert buffer.tree[np.array([15])] == 0


def test_reset_forgets_priorities() -> None:
    buffer = make_buffer()
    buffer.update_priorities(np.arange(10), th.full((10, 1), 9.0))
    buffer.reset()
    assert buffer.tree.total == 0
    play(buffer, range(100, 102))
    np.testing.assert_array_equal(buffer.tree[np.arange(3)], [1, 1, 0])


@pytest.mark.parametrize("n_steps", [1, 3])
def test_sacfd_hands_back_its_errors(n_steps: int, make_toy: Any) -> None:
    model = SACfD(
        "MultiInputPolicy",
        make_toy(),
        replay_buffer_class=PrioritizedReplayBuffer,
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
    assert isinstance(buffer, PrioritizedReplayBuffer)
    assert buffer.progress_remaining == model._current_progress_remaining == 0
    samples = buffer.sample(8)
    buffer.sample = lambda *args, **kwargs: samples  # type: ignore[method-assign]
    th.manual_seed(0)
    with th.no_grad():
        model.actor.action_log_prob(samples.observations)  # draws noise as the update does
        actions, _ = model.actor.action_log_prob(samples.next_observations)
        next_values = th.stack(model.critic_target(samples.next_observations, actions)).amin(dim=0)
        target = samples.rewards + (1 - samples.dones) * samples.discounts * next_values
        values = model.critic(samples.observations, samples.actions)
        errors = sum((value - target).abs() for value in values) / 2
    th.manual_seed(0)
    model.train(1, 8)
    expected = {
        slot: error + expert + MIN_PRIORITY
        for slot, error, expert in zip(
            samples.indices, errors[:, 0].tolist(), samples.is_expert[:, 0].tolist(), strict=True
        )
    }
    stored = buffer.tree[np.array(list(expected))] ** (1 / 0.6)
    np.testing.assert_allclose(stored, list(expected.values()), rtol=1e-4)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"exponent": 1.5}, "exponent"),
        ({"beta_start": -0.1}, "beta_start"),
        ({"expert_bonus": -1.0}, "expert_bonus"),
        ({"expert_fraction": 0.5}, "expert_fraction"),
        ({"expert_fraction": 0.5, "balanced_from": 8}, "expert_fraction must be None"),
        ({"balanced_from": 8}, "balanced_from"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(**kwargs)
