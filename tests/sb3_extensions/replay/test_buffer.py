"""Storage, samplers and quantisation of the replay buffer compared with slow references."""

import pickle
from typing import NamedTuple

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.quantisation import Quantiser
from sb3_extensions.replay.sampling import MIN_PRIORITY, PrioritizedSampler, ShareSampler

HEIGHT = 0.4
OBSERVATION_SPACE = spaces.Dict(
    {
        "image": spaces.Box(0.0, HEIGHT, (1, 4, 4), np.float32),
        "number": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    }
)
GAMMA = 0.9


def make_buffer(size=50, n_envs=1, space=OBSERVATION_SPACE, **kwargs):
    actions = spaces.Box(-1, 1, (3,), np.float32)
    return ExpertReplayBuffer(size, space, actions, device="cpu", n_envs=n_envs, seed=0, **kwargs)


def observe(ids):
    """Return observations that encode a number exactly in one entry, and as brightness of the image."""
    image = np.broadcast_to((ids % 256)[:, None, None, None] / 255 * HEIGHT, (len(ids), 1, 4, 4))
    return {"image": image.astype(np.float32), "number": np.stack([ids, -ids], axis=1).astype(np.float32)}


class Step(NamedTuple):
    """A step from the observation with a number to that with the next number."""

    number: int
    reward: float
    action: np.ndarray
    terminated: bool
    done: bool


class Player:
    """Adds steps to a buffer as an algorithm does, and remembers those of each environment in a list."""

    def __init__(self, buffer):
        self.buffer, self.rng = buffer, np.random.default_rng(0)
        self.numbers = 1000 * np.arange(1, buffer.n_envs + 1)
        self.steps = [[] for _ in self.numbers]

    def step(self, p_terminate=0.1, p_truncate=0.1):
        n_envs = self.buffer.n_envs
        terminated = self.rng.random(n_envs) < p_terminate
        truncated = (self.rng.random(n_envs) < p_truncate) & ~terminated
        done = terminated | truncated
        rewards = self.rng.random(n_envs, dtype=np.float32)
        actions = self.rng.uniform(-1, 1, (n_envs, 3)).astype(np.float32)
        infos = [{"TimeLimit.truncated": value} for value in truncated]
        self.buffer.add(observe(self.numbers), observe(self.numbers + 1), actions, rewards, done, infos)
        columns = (self.numbers, rewards, actions, terminated, done)
        for steps, *values in zip(self.steps, *columns, strict=True):
            steps.append(Step(*values))
        self.numbers = self.numbers + 1 + done  # the next episode begins with another observation


def expert_episode(length, first=100):
    actions = np.full((length, 3), 0.5, dtype=np.float32)
    terminations = np.arange(length) == length - 1
    return observe(np.arange(first, first + length + 1)), actions, np.ones(length), terminations


def sampled_ids(tensors):
    return tensors["number"][:, 0].numpy().astype(int)


def find_kept(player, size):
    """Return the latest steps that fit into rings of ``size`` rows, each with those that follow it."""
    kept = {}
    for steps in player.steps:
        rows, episode = 1, []  # a row of the last observation
        for step in reversed(steps):
            # The row after the end of an episode is free until its next step.
            rows += 2 if step.done and step is not steps[-1] else 1
            if rows > size:
                break
            episode = [step, *([] if step.done else episode)]
            kept[step.number] = episode
    return kept


@pytest.mark.parametrize(
    ("sampler", "n_envs", "n_steps"), [("uniform", 1, 1), ("uniform", 3, 3), ("prioritized", 1, 3)]
)
def test_samples_equal_a_slow_reference(sampler, n_envs, n_steps):
    buffer = make_buffer(40 * n_envs + 1, n_envs, n_steps=n_steps, gamma=GAMMA, sampler=sampler)
    player = Player(buffer)
    for _ in range(200):  # several times around
        player.step()
    kept = find_kept(player, buffer.table.ring_length)
    assert buffer.size() == len(kept) > 20 * n_envs
    samples = buffer.sample(2000)
    observed = sampled_ids(samples.observations)
    assert set(observed) == set(kept)
    episodes = [kept[number][:n_steps] for number in observed]
    expected = {
        "actions": [steps[0].action for steps in episodes],
        "dones": [[steps[-1].terminated] for steps in episodes],
        "rewards": [[sum(GAMMA**k * step.reward for k, step in enumerate(steps))] for steps in episodes],
        "discounts": [[GAMMA ** len(steps)] for steps in episodes],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(samples, name), values, rtol=1e-5, err_msg=name)
    assert sampled_ids(samples.next_observations).tolist() == [steps[-1].number + 1 for steps in episodes]


def test_memory_of_100000_steps_and_warning_without_it(monkeypatch):
    image, number = spaces.Box(0.0, 0.4, (1, 128, 128), np.float32), spaces.Box(0.0, 1.0, (1,), np.float32)
    buffer = make_buffer(109_000, n_envs=5, space=spaces.Dict({"heightmap": image, "holding": number}))
    assert buffer.table.nbytes < 1.8e9  # each image is stored once
    memory = type("Memory", (), {"available": 1000})
    monkeypatch.setattr("sb3_extensions.replay.buffer.psutil.virtual_memory", lambda: memory)
    with pytest.warns(UserWarning, match="replay buffer needs"):
        make_buffer()


def test_reset_in_the_middle_of_an_episode_ends_it():
    buffer = make_buffer(n_steps=3, gamma=GAMMA)
    player = Player(buffer)
    player.step(0, 0)
    player.numbers += 50  # as env.reset() does between two learn()
    player.step(0, 0)
    samples = buffer.sample(100)
    first = sampled_ids(samples.observations) == 1000
    assert (sampled_ids(samples.next_observations)[first] == 1001).all()
    np.testing.assert_allclose(samples.discounts.numpy(), GAMMA, rtol=1e-6)


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
def test_expert_rows_are_never_overwritten(sampler):
    buffer = make_buffer(size=30, sampler=sampler)
    buffer.add_episode(*expert_episode(4, first=100))
    buffer.add_episode(*expert_episode(3, first=200))
    player = Player(buffer)
    expert = {(k, k + 1) for k in (*range(100, 104), *range(200, 203))}
    for _ in range(100):
        player.step(p_terminate=0.4)
        samples = buffer.sample(200)
        is_expert = samples.is_expert[:, 0]
        pairs = zip(sampled_ids(samples.observations), sampled_ids(samples.next_observations), strict=True)
        assert {pair for pair, flag in zip(pairs, is_expert, strict=True) if flag} == expert
        assert (samples.actions[is_expert] == 0.5).all() and (samples.expert_actions[is_expert] == 0.5).all()
        assert samples.expert_actions[~is_expert].isnan().all()
    assert buffer.expert_size == 7


def test_demonstrations_fit_the_buffer_and_come_first():
    buffer = make_buffer(size=20)
    with pytest.raises(ValueError, match=r"buffer_size .* 24 .* got 20"):
        buffer.add_episode(*expert_episode(20))
    Player(buffer).step()
    with pytest.raises(ValueError, match="before the first online"):
        buffer.add_episode(*expert_episode(4))


def test_timeouts_bootstrap_by_default():
    """Also those of expert episodes."""
    for handle, expected in [(True, 0.0), (False, 1.0)]:
        buffer = make_buffer(handle_timeout_termination=handle)
        buffer.add_episode(*expert_episode(3)[:3], terminations=[False] * 3)
        Player(buffer).step(p_terminate=0, p_truncate=1)
        assert buffer.steps("done").tolist() == [0.0, 0.0, expected, expected]


def test_pickles_have_used_rows_only_and_give_equal_samples():
    buffer = make_buffer(size=10_000, n_steps=2, gamma=GAMMA)
    buffer.add_episode(*expert_episode(4))
    Player(buffer).step()
    data = pickle.dumps(buffer)
    assert len(data) < 10_000
    copy = pickle.loads(data)
    np.testing.assert_array_equal(copy.sample(50).indices, buffer.sample(50).indices)
    assert copy.sample(50).is_expert.any()


def test_a_sampler_object_serves_several_buffers():
    sampler = ShareSampler(0.25)
    first, second = (make_buffer(sampler=sampler) for _ in range(2))
    assert first.sampler.expert_fraction == second.sampler.expert_fraction == 0.25
    assert first.sampler.table is first.table and second.sampler.table is second.table
    assert "table" not in vars(sampler)  # otherwise it would be saved with the arguments of a model


def test_vec_normalize(make_toy):
    env = VecNormalize(make_toy(), norm_obs_keys=["heightmap"])
    model = SAC("MultiInputPolicy", env, learning_starts=10, replay_buffer_class=ExpertReplayBuffer, seed=0)
    buffer = model.learn(30).replay_buffer
    samples = []
    for kwargs in {}, {"env": env}:
        buffer.seed(1)
        samples.append(buffer.sample(20, **kwargs))
    raw, normalised = samples
    assert raw.observations["heightmap"].min() >= 0
    expected = env.normalize_obs({key: value.numpy() for key, value in raw.observations.items()})
    np.testing.assert_allclose(normalised.observations["heightmap"], expected["heightmap"], rtol=1e-6)
    np.testing.assert_allclose(normalised.rewards, env.normalize_reward(raw.rewards.numpy()), rtol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("low, high", [(0, 0.4), (-1, 1), (0.1, 0.35), (-3, 100)])
def test_tensors_and_arrays_are_rounded_to_the_nearest_level(low, high, dtype):
    quantiser = Quantiser(spaces.Box(low, high, (1, 4, 4), np.float32), dtype)
    levels = np.arange(quantiser.levels + 1).astype(dtype)
    exact = quantiser.decode(levels)
    assert exact.dtype == np.float32 and quantiser.encode(exact).dtype == np.dtype(dtype)
    np.testing.assert_array_equal(quantiser.encode(exact), levels)
    assert exact[0] == np.float32(low) and exact[-1] == pytest.approx(high, rel=1e-6)
    margin, unit = 0.1 * (high - low), (high - low) / quantiser.levels
    values = np.random.default_rng(0).uniform(low - margin, high + margin, 10_000).astype(np.float32)
    stored = quantiser.decode(quantiser.encode(values))
    np.testing.assert_allclose(stored, np.clip(values, low, high), atol=0.51 * unit)
    np.testing.assert_array_equal(quantiser.round_trip(th.from_numpy(values)), stored)
    seen, trained = (quantiser.normalise(th.from_numpy(x)) for x in (values, stored))
    assert th.equal(seen, trained) and seen.min() == 0 and seen.max() == 1
    np.testing.assert_allclose(seen, (stored - low) / (high - low), atol=1e-5)


BATCH = 16


def make_numbered_buffer(n_expert, size=400, **kwargs):
    """Return a buffer with expert episodes of one step, numbered from 0 by their observations."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    arguments = {"device": "cpu", "seed": 0, **kwargs}
    buffer = ExpertReplayBuffer(size, space, spaces.Box(-1, 1, (1,)), **arguments)
    for number in range(n_expert):
        observations = {"observation": np.full((2, 1), number)}
        buffer.add_episode(observations, np.zeros((1, 1)), np.ones(1), np.ones(1, bool))
    return buffer


def play(buffer, n_steps=1):
    """Add online episodes of one step."""
    for _ in range(n_steps):
        obs = np.full((1, 1), 1000 + buffer.size(), np.float32)
        buffer.add(obs, obs, np.zeros((1, 1)), np.zeros(1), np.ones(1, bool), [{}])


@pytest.mark.parametrize(
    ("options", "n_expert", "first"),
    [({"balanced_from": 8}, 20, 8), ({"balanced_from": 8}, 7, 30), ({}, 20, 1)],
)
def test_shares_apply_from_balanced_from_steps(options, n_expert, first):
    """Of both kinds; by default from the first online step."""
    divided = make_numbered_buffer(n_expert, sampler={"shares": {"expert_fraction": 0.5, **options}})
    uniform = make_numbered_buffer(n_expert)
    for online in range(1, 30):
        for buffer in (divided, uniform):
            play(buffer)
            buffer.seed(5)
        samples, others = divided.sample(BATCH), uniform.sample(BATCH)
        assert np.array_equal(samples.indices, others.indices) == (online < first)
        assert online < first or samples.is_expert.sum() == BATCH // 2


@pytest.fixture(params=[0.0, 0.6])
def buffer(request):
    """Buffer of a prioritized sampler with four expert steps and six online steps."""
    made = make_numbered_buffer(4, sampler={"prioritized": {"exponent": request.param}})
    play(made, 6)
    return made


def valid_rows(buffer):
    return np.flatnonzero(buffer.table.columns["valid"])


@pytest.mark.parametrize(("progress_remaining", "beta"), [(1.0, 0.4), (0.25, 0.85), (0.0, 1.0)])
def test_probabilities_and_weights_follow_the_priorities(progress_remaining, beta, buffer):
    rows, errors = valid_rows(buffer), np.linspace(-2, 3, 10)
    buffer.update_priorities(rows, th.as_tensor(abs(errors))[:, None])
    priorities = np.abs(errors) + MIN_PRIORITY
    priorities[:4] += 1
    probabilities = priorities**buffer.sampler.exponent
    probabilities /= probabilities.sum()
    buffer.sampler.progress_remaining = progress_remaining
    samples = buffer.sample(100_000)
    counts = np.bincount(samples.indices, minlength=rows[-1] + 1)
    np.testing.assert_allclose(counts[rows] / 100_000, probabilities, atol=1e-4)
    assert counts.sum() == counts[rows].sum()
    weights = (10 * probabilities) ** -beta
    expected = (weights / weights.max())[np.searchsorted(rows, samples.indices)]
    np.testing.assert_allclose(samples.weights.numpy()[:, 0], expected, rtol=1e-5)


def test_default_priorities_are_the_papers():
    sampler = PrioritizedSampler()
    assert (sampler.exponent, sampler.beta_start, sampler.expert_bonus) == (0.6, 0.4, 1.0)


def test_a_new_step_gets_the_maximum_of_the_present_priorities(buffer):
    rows = valid_rows(buffer)
    np.testing.assert_array_equal(buffer.sampler.masses[rows], 1.0)
    buffer.update_priorities(rows[-1:], th.tensor([[5.0]]))
    buffer.update_priorities(rows, th.full((10, 1), 0.2))
    play(buffer)
    new = valid_rows(buffer)[-1:]  # expert steps have a bonus
    np.testing.assert_allclose(buffer.sampler.masses[new], (1.2 + MIN_PRIORITY) ** buffer.sampler.exponent)
    buffer.reset()
    with pytest.raises(ValueError, match="at least one step, got 0"):
        buffer.sample(1)
