"""Storage and sampling of the replay buffer compared with slow references."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.quantisation import Quantiser

HEIGHT = 0.4
OBSERVATION_SPACE = spaces.Dict(
    {
        "image": spaces.Box(0.0, HEIGHT, (1, 4, 4), np.float32),
        "number": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    }
)
ACTION_SPACE = spaces.Box(-1, 1, (3,), np.float32)
GAMMA = 0.9
both_samplers = pytest.mark.parametrize("sampler", ["uniform", "prioritized"])


def make_buffer(size: int = 50, n_envs: int = 1, space=OBSERVATION_SPACE, **kwargs) -> ExpertReplayBuffer:
    return ExpertReplayBuffer(size, space, ACTION_SPACE, device="cpu", n_envs=n_envs, seed=0, **kwargs)


def observe(ids: np.ndarray) -> dict[str, np.ndarray]:
    """Return observations that encode a number exactly in one entry, and as brightness of the image."""
    image = np.broadcast_to((ids % 256)[:, None, None, None] / 255 * HEIGHT, (len(ids), 1, 4, 4))
    return {
        "image": image.astype(np.float32),
        "number": np.stack([ids, -ids], axis=1).astype(np.float32),
    }


class Player:
    """Adds episodes to a buffer as an algorithm does, and remembers all transitions in a list."""

    def __init__(self, buffer, seed: int = 0):
        self.buffer, self.rng = buffer, np.random.default_rng(seed)
        self.n_envs = buffer.n_envs
        self.next_id = 1000 * np.arange(1, self.n_envs + 1)
        self.obs = self.next_id.copy()
        self.transitions = []
        self.latest = [None] * self.n_envs

    def step(self, p_terminate: float = 0.1, p_truncate: float = 0.1):
        terminated = self.rng.random(self.n_envs) < p_terminate
        truncated = (self.rng.random(self.n_envs) < p_truncate) & ~terminated
        done = terminated | truncated
        self.next_id += 1
        next_obs = self.next_id.copy()
        action = self.rng.uniform(-1, 1, (self.n_envs, 3)).astype(np.float32)
        reward = self.rng.random(self.n_envs).astype(np.float32)
        infos = [
            {"TimeLimit.truncated": bool(t), "is_success": bool(r > 0.5)}
            for t, r in zip(truncated, reward, strict=True)
        ]
        self.buffer.add(observe(self.obs), observe(next_obs), action, reward, done, infos)
        for i in range(self.n_envs):
            transition = {
                "obs": self.obs[i],
                "next": next_obs[i],
                "reward": reward[i],
                "action": action[i],
                "terminated": terminated[i],
                "done": done[i],
                "successor": None,
                "success": bool(done[i] and reward[i] > 0.5),
            }
            if (latest := self.latest[i]) is not None:
                latest["successor"] = transition
            self.latest[i] = None if done[i] else transition
            self.transitions.append(transition)
        self.next_id += done  # the next episode begins with another observation
        self.obs = self.next_id.copy()


def expert_episode(length: int, first: int = 100) -> tuple[Any, ...]:
    actions = np.full((length, 3), 0.5, dtype=np.float32)
    terminations = np.arange(length) == length - 1
    return observe(np.arange(first, first + length + 1)), actions, np.ones(length), terminations


def sampled_ids(tensors: dict[str, th.Tensor]) -> np.ndarray:
    return tensors["number"][:, 0].numpy().astype(int)


def find_kept(player: Player, size: int) -> dict[int, dict[str, Any]]:
    """Return the latest steps of each environment that fit into a ring of ``size`` rows."""
    kept = {}
    for env in range(player.n_envs):
        steps = player.transitions[env :: player.n_envs]
        rows = 1  # of the last observation
        for step in reversed(steps):
            # The row after the end of an episode is free until its next step.
            rows += 2 if step["done"] and step is not steps[-1] else 1
            if rows > size:
                break
            kept[step["obs"]] = step
    return kept


@both_samplers
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_samples_equal_a_slow_reference(sampler, n_envs, n_steps):
    buffer = make_buffer(40 * n_envs + 1, n_envs, n_steps=n_steps, gamma=GAMMA, sampler=sampler)
    player = Player(buffer)
    for _ in range(200):  # several times around
        player.step()
    reference = find_kept(player, buffer.table.ring_length)
    assert buffer.size() == len(reference) > 20 * n_envs
    samples = buffer.sample(2000)
    observed = sampled_ids(samples.observations)
    assert set(observed) == set(reference)
    for k, obs in enumerate(observed):
        first = last = reference[obs]
        reward, discount = first["reward"], GAMMA
        while last["successor"] is not None and discount > GAMMA**n_steps * 1.001:
            last = last["successor"]
            reward, discount = reward + discount * last["reward"], discount * GAMMA
        assert sampled_ids(samples.next_observations)[k] == last["next"]
        assert samples.dones[k].item() == last["terminated"]
        np.testing.assert_allclose(samples.rewards[k].item(), reward, rtol=1e-5)
        np.testing.assert_allclose(samples.discounts[k].item(), discount, rtol=1e-5)
        np.testing.assert_array_equal(samples.actions[k], first["action"])
        assert samples.succeeded[k].item() == leads_to_success(first)


def leads_to_success(step: dict[str, Any]) -> bool:
    """Whether the episode of a step succeeded."""
    while step["successor"] is not None:
        step = step["successor"]
    return bool(step["success"])


def test_each_observation_is_stored_once(monkeypatch):
    player = Player(make_buffer(size=50, n_envs=2))
    for _ in range(10):
        player.step(0, 0)
    assert player.buffer.table.heads.tolist() == [10, 35]
    player.step(1, 0)
    player.step(0, 0)
    assert player.buffer.table.heads.tolist() == [13, 38]  # one row more for the end of the episode
    image, number = spaces.Box(0.0, 0.4, (1, 128, 128), np.float32), spaces.Box(0.0, 1.0, (1,), np.float32)
    space = spaces.Dict({"heightmap": image, "holding": number})
    buffer = make_buffer(109_000, n_envs=5, space=space)  # 100,000 steps
    assert buffer.table.nbytes < 1.8e9
    memory = type("Memory", (), {"available": 1000})
    monkeypatch.setattr("sb3_extensions.replay.buffer.psutil.virtual_memory", lambda: memory)
    with pytest.warns(UserWarning, match="replay buffer needs"):
        make_buffer()


def test_reset_in_the_middle_of_an_episode_ends_it():
    buffer = make_buffer(n_steps=3, gamma=GAMMA)
    player = Player(buffer)
    player.step(0, 0)
    player.obs = player.next_id = player.next_id + 50  # as env.reset() does between two learn()
    player.step(0, 0)
    samples = buffer.sample(100)
    first = sampled_ids(samples.observations) == 1000
    assert (sampled_ids(samples.next_observations)[first] == 1001).all()
    np.testing.assert_allclose(samples.discounts.numpy(), GAMMA, rtol=1e-6)


@both_samplers
def test_expert_rows_are_never_overwritten(sampler):
    buffer = make_buffer(size=30, sampler=sampler)
    buffer.add_episode(*expert_episode(4, first=100))
    buffer.add_episode(*expert_episode(3, first=200))
    player = Player(buffer)
    expert = {(100 + k, 101 + k) for k in range(4)} | {(200 + k, 201 + k) for k in range(3)}
    for _ in range(100):
        player.step(p_terminate=0.4)
        samples = buffer.sample(200)
        is_expert = samples.is_expert.numpy()[:, 0]
        pairs = zip(sampled_ids(samples.observations), sampled_ids(samples.next_observations), strict=True)
        seen = {pair for pair, flag in zip(pairs, is_expert, strict=True) if flag}
        assert seen == expert
        assert (samples.actions[samples.is_expert[:, 0]] == 0.5).all()
        assert (samples.expert_actions[samples.is_expert[:, 0]] == 0.5).all()
        assert samples.expert_actions[~samples.is_expert[:, 0]].isnan().all()
        assert (sampled_ids(samples.observations)[~is_expert] >= 1000).all()
    assert buffer.expert_size == 7


def test_add_episode_rejects_small_buffer_and_online_steps():
    buffer = make_buffer(size=20)
    with pytest.raises(ValueError, match="buffer_size must be at least 24 for the demonstrations, got 20"):
        buffer.add_episode(*expert_episode(20))
    buffer = make_buffer(size=20)
    Player(buffer).step()
    with pytest.raises(ValueError, match="before the first online"):
        buffer.add_episode(*expert_episode(4))


def test_timeouts_bootstrap_by_default():
    for handle, expected in [(True, 0.0), (False, 1.0)]:
        buffer = make_buffer(handle_timeout_termination=handle)
        Player(buffer).step(p_terminate=0, p_truncate=1)
        assert buffer.sample(1).dones.item() == expected


def test_pickles_have_used_rows_only_and_give_equal_samples():
    buffer = make_buffer(size=10_000, n_steps=2, gamma=GAMMA)
    buffer.add_episode(*expert_episode(4))
    Player(buffer).step()
    data = pickle.dumps(buffer)
    assert len(data) < 10_000
    copy = pickle.loads(data)
    np.testing.assert_array_equal(copy.sample(50).indices, buffer.sample(50).indices)
    assert copy.sample(50).is_expert.any()


def test_reset_removes_all_steps():
    buffer = make_buffer()
    buffer.add_episode(*expert_episode(4))
    Player(buffer).step()
    buffer.reset()
    assert buffer.size() == 0
    with pytest.raises(ValueError, match="at least one step, got 0"):
        buffer.sample(1)
    buffer.add_episode(*expert_episode(2))
    assert set(sampled_ids(buffer.sample(20).observations)) == {100, 101}


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"n_steps": 0}, "n_steps"),
        ({"n_steps": 3}, "gamma"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        ({"sampler": {"shares": {"expert_fraction": 1.5}}}, "expert_fraction .* got 1.5"),
        ({"sampler": "best"}, "sampler .*uniform, shares, prioritized, .* got 'best'"),
        ({"image_dtype": "float32"}, "dtype"),
        ({"size": 1}, "buffer_size"),
        ({"space": spaces.Discrete(3)}, "Box"),
        ({"space": spaces.Dict({"a": spaces.Discrete(3)})}, "Box"),
    ],
)
def test_invalid_arguments_are_rejected(kwargs, named):
    with pytest.raises(ValueError, match=named):
        make_buffer(**kwargs)


def test_vec_normalize(make_toy):
    env = VecNormalize(make_toy(), norm_obs_keys=["heightmap"])
    model = SAC("MultiInputPolicy", env, learning_starts=10, replay_buffer_class=ExpertReplayBuffer, seed=0)
    model.learn(30)
    raw = model.replay_buffer.sample(20).observations["heightmap"]
    model.replay_buffer.seed(1)
    a = model.replay_buffer.sample(20)
    model.replay_buffer.seed(1)
    b = model.replay_buffer.sample(20, env=env)
    assert raw.min() >= 0
    expected = env.normalize_obs({key: value.numpy() for key, value in a.observations.items()})
    np.testing.assert_allclose(b.observations["heightmap"], expected["heightmap"], rtol=1e-6)
    np.testing.assert_allclose(b.rewards, env.normalize_reward(a.rewards.numpy()), rtol=1e-6)


BOUNDS = [(0, 0.4), (-1, 1), (0.1, 0.35), (-3, 100)]


def box(low, high) -> spaces.Box:
    return spaces.Box(low, high, (1, 4, 4), np.float32)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("low, high", BOUNDS)
def test_tensors_and_arrays_are_rounded_to_the_nearest_level(low, high, dtype):
    quantiser = Quantiser(box(low, high), dtype)
    levels = np.arange(quantiser.levels + 1).astype(dtype)
    exact = quantiser.decode(levels)
    assert exact.dtype == np.float32 and quantiser.encode(exact).dtype == np.dtype(dtype)
    np.testing.assert_array_equal(quantiser.encode(exact), levels)
    assert exact[0] == np.float32(low) and exact[-1] == pytest.approx(high, rel=1e-6)
    margin = 0.1 * (high - low)
    values = np.random.default_rng(0).uniform(low - margin, high + margin, 10_000).astype(np.float32)
    stored = quantiser.decode(quantiser.encode(values))
    tensor = th.from_numpy(values.copy()).requires_grad_()
    rounded = quantiser.round_trip(tensor)
    np.testing.assert_array_equal(rounded.numpy(), stored)
    np.testing.assert_array_equal(tensor.detach(), values)
    seen, trained = (quantiser.normalise(th.from_numpy(x)) for x in (values, stored))
    assert th.equal(seen, trained) and seen.min() == 0 and seen.max() == 1
    np.testing.assert_allclose(
        stored, np.clip(values, low, high), atol=0.51 * (high - low) / quantiser.levels
    )
    np.testing.assert_allclose(seen, (stored - low) / (high - low), atol=1e-5)


def test_each_entry_may_have_its_own_bounds():
    quantiser = Quantiser(spaces.Box(np.float32([[0, -1]]), np.float32([[1, 3]]), dtype=np.float32))
    levels, values = np.uint8([[[255, 0]], [[0, 255]]]), np.float32([[[1, -1]], [[0, 3]]])
    np.testing.assert_array_equal(quantiser.decode(levels), values)
    np.testing.assert_array_equal(quantiser.encode(values), levels)
    np.testing.assert_array_equal(quantiser.round_trip(th.from_numpy(values)), values)


@pytest.mark.parametrize(
    "space, dtype, named",
    [
        (box(0, np.inf), "uint8", "finite"),
        (box(1, 1), "uint8", "low < high"),
        (box(0, 1), "int8", "dtype"),
        (box(1000, 1000.01), "uint16", "too narrow"),
    ],
)
def test_quantiser_rejects_unusable_bounds(space, dtype, named):
    with pytest.raises(ValueError, match=named):
        Quantiser(space, dtype)
