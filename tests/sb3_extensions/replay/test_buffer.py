"""The replay buffer: what it stores and what it samples, against slow references."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from sb3_contrib.crossq.policies import CrossQPolicy
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.replay.buffer import EXPERT_ACTION, EXPLORED, ExpertReplayBuffer

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


def make_buffer(size: int = 50, n_envs: int = 1, **kwargs: Any) -> ExpertReplayBuffer:
    return ExpertReplayBuffer(
        size, OBSERVATION_SPACE, ACTION_SPACE, device="cpu", n_envs=n_envs, seed=0, **kwargs
    )


def observe(ids: np.ndarray) -> dict[str, np.ndarray]:
    """Observations that carry a number each, in one entry exactly and in the image as brightness."""
    image = np.broadcast_to((ids % 256)[:, None, None, None] / 255 * HEIGHT, (len(ids), 1, 4, 4))
    return {
        "image": image.astype(np.float32),
        "number": np.stack([ids, -ids], axis=1).astype(np.float32),
    }


class Player:
    """Adds episodes to a buffer as an algorithm does, and remembers all transitions in a list."""

    def __init__(self, buffer: Any, seed: int = 0) -> None:
        self.buffer, self.rng = buffer, np.random.default_rng(seed)
        self.n_envs = buffer.n_envs
        self.next_id = 1000 * np.arange(1, self.n_envs + 1)
        self.obs = self.next_id.copy()
        self.transitions: list[dict[str, Any]] = []
        self.latest: list[dict[str, Any] | None] = [None] * self.n_envs

    def step(self, p_terminate: float = 0.1, p_truncate: float = 0.1, p_explore: float = 0.0) -> None:
        terminated = self.rng.random(self.n_envs) < p_terminate
        truncated = (self.rng.random(self.n_envs) < p_truncate) & ~terminated
        done = terminated | truncated
        self.next_id += 1
        next_obs = self.next_id.copy()
        action = self.rng.uniform(-1, 1, (self.n_envs, 3)).astype(np.float32)
        reward = self.rng.random(self.n_envs).astype(np.float32)
        explored = self.rng.random(self.n_envs) < p_explore
        infos: list[dict[str, Any]] = [
            {"TimeLimit.truncated": bool(t), "is_success": bool(r > 0.5)}
            for t, r in zip(truncated, reward, strict=True)
        ]
        for info in (info for info, flag in zip(infos, explored, strict=True) if flag):
            info[EXPLORED] = True
        self.buffer.add(observe(self.obs), observe(next_obs), action, reward, done, infos)
        for i in range(self.n_envs):
            transition = {
                "obs": self.obs[i],
                "next": next_obs[i],
                "reward": reward[i],
                "action": action[i],
                "terminated": terminated[i],
                "done": done[i],
                "explored": explored[i],
                "successor": None,
                "success": bool(done[i] and reward[i] > 0.5),
            }
            if (latest := self.latest[i]) is not None:
                latest["successor"] = transition
            self.latest[i] = None if done[i] else transition
            self.transitions.append(transition)
        self.next_id += done  # the next episode begins with an observation of its own
        self.obs = self.next_id.copy()


def expert_episode(length: int, first: int = 100) -> tuple[Any, ...]:
    actions = np.full((length, 3), 0.5, dtype=np.float32)
    terminations = np.arange(length) == length - 1
    return observe(np.arange(first, first + length + 1)), actions, np.ones(length), terminations


def sampled_ids(tensors: dict[str, th.Tensor]) -> np.ndarray:
    return tensors["number"][:, 0].numpy().astype(int)


def find_kept(player: Player, size: int) -> dict[int, dict[str, Any]]:
    """Return the latest steps of each environment that fit into a ring of ``size`` rows."""
    kept: dict[int, dict[str, Any]] = {}
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
@pytest.mark.parametrize("p_explore", [0.0, 0.3])
def test_samples_equal_a_slow_reference(sampler: str, n_envs: int, n_steps: int, p_explore: float) -> None:
    buffer = make_buffer(40 * n_envs + 1, n_envs, n_steps=n_steps, gamma=GAMMA, sampler=sampler)
    player = Player(buffer)
    for _ in range(200):  # several times around
        player.step(p_explore=p_explore)
    reference = find_kept(player, buffer.table.ring_length)
    assert buffer.size() == len(reference) > 20 * n_envs
    samples = buffer.sample(2000)
    observed = sampled_ids(samples.observations)
    assert set(observed) == set(reference)
    for k, obs in enumerate(observed):
        first = last = reference[obs]
        reward, discount = first["reward"], GAMMA
        while last["successor"] is not None and discount > GAMMA**n_steps * 1.001:
            if last["successor"]["explored"]:
                break
            last = last["successor"]
            reward, discount = reward + discount * last["reward"], discount * GAMMA
        assert sampled_ids(samples.next_observations)[k] == last["next"]
        assert samples.dones[k].item() == last["terminated"]
        np.testing.assert_allclose(samples.rewards[k].item(), reward, rtol=1e-5)
        np.testing.assert_allclose(samples.discounts[k].item(), discount, rtol=1e-5)
        np.testing.assert_array_equal(samples.actions[k], first["action"])
        assert samples.succeeded[k].item() == leads_to_success(first)


def leads_to_success(step: dict[str, Any]) -> bool:
    """Whether the episode succeeded without an exploratory action after a step."""
    while (after := step["successor"]) is not None:
        if after["explored"]:
            return False
        step = after
    return bool(step["success"])


def test_each_observation_is_stored_once() -> None:
    buffer = make_buffer(size=50, n_envs=2)
    player = Player(buffer)
    for _ in range(10):
        player.step(0, 0)
    assert buffer.table.heads.tolist() == [10, 35]
    player.step(1, 0)
    player.step(0, 0)
    assert buffer.table.heads.tolist() == [13, 38]  # one row more for the end of the episode


def test_reset_in_the_middle_of_an_episode_ends_it() -> None:
    buffer = make_buffer(n_steps=3, gamma=GAMMA)
    player = Player(buffer)
    player.step(0, 0)
    player.obs = player.next_id = player.next_id + 50  # as env.reset() does between two learn()
    player.step(0, 0)
    samples = buffer.sample(100)
    first = sampled_ids(samples.observations) == 1000
    assert (sampled_ids(samples.next_observations)[first] == 1001).all()
    np.testing.assert_allclose(samples.discounts.numpy(), GAMMA, rtol=1e-6)


def test_memory_of_100_000_steps_of_128_pixels() -> None:
    space = spaces.Dict(
        {
            "heightmap": spaces.Box(0.0, 0.4, (1, 128, 128), np.float32),
            "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
    )
    buffer = ExpertReplayBuffer(109_000, space, spaces.Box(-1, 1, (5,)), n_envs=5)
    assert buffer.table.nbytes < 1.8e9


def test_buffer_larger_than_the_available_memory_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = type("Memory", (), {"available": 1000})
    monkeypatch.setattr("sb3_extensions.replay.buffer.psutil.virtual_memory", lambda: memory)
    with pytest.warns(UserWarning, match="replay buffer needs"):
        make_buffer()


@both_samplers
def test_expert_rows_are_never_overwritten(sampler: str) -> None:
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


def test_what_an_expert_would_have_done() -> None:
    buffer = make_buffer(n_envs=2, size=50)
    for k in range(60):
        ids = np.array([k, 1000 + k])
        infos = [{EXPERT_ACTION: np.full(3, k / 100)}, {}]
        buffer.add(observe(ids), observe(ids + 1), np.zeros((2, 3)), np.zeros(2), np.zeros(2, bool), infos)
    samples = buffer.sample(200)
    ids = sampled_ids(samples.observations)
    expected = np.where(np.array(ids) < 1000, np.array(ids) / 100, np.nan).astype(np.float32)
    for column in samples.expert_actions.numpy().T:
        np.testing.assert_array_equal(column, expected)
    assert not samples.is_expert.any()


def test_expert_episodes_come_first_and_fit() -> None:
    buffer = make_buffer(size=20)
    with pytest.raises(ValueError, match="buffer_size must be at least 24 for the demonstrations, got 20"):
        buffer.add_episode(*expert_episode(20))
    buffer = make_buffer(size=20)
    Player(buffer).step()
    with pytest.raises(ValueError, match="before the first online"):
        buffer.add_episode(*expert_episode(4))


@pytest.mark.parametrize(("dtype", "levels"), [("uint8", 255), ("uint16", 65535)])
def test_quantisation_error_is_at_most_half_a_step(dtype: str, levels: int) -> None:
    buffer = make_buffer(image_dtype=dtype)
    rng = np.random.default_rng(0)
    image = rng.uniform(0, HEIGHT, (1, 1, 4, 4)).astype(np.float32)
    obs = {"image": image, "number": np.zeros((1, 2), np.float32)}
    buffer.add(obs, obs, np.zeros((1, 3)), np.zeros(1), np.zeros(1, bool), [{}])
    sample = buffer.sample(1).observations["image"]
    assert sample.dtype == th.float32
    assert np.abs(sample.numpy() - image).max() <= HEIGHT / levels / 2 * 1.001


def test_timeouts_bootstrap_by_default() -> None:
    for handle, expected in [(True, 0.0), (False, 1.0)]:
        buffer = make_buffer(handle_timeout_termination=handle)
        Player(buffer).step(p_terminate=0, p_truncate=1)
        assert buffer.sample(1).dones.item() == expected


@both_samplers
def test_same_seed_same_samples_and_pickle(sampler: str) -> None:
    buffers = [make_buffer(size=20, n_steps=2, gamma=GAMMA, sampler=sampler) for _ in range(2)]
    for buffer in buffers:
        buffer.add_episode(*expert_episode(4))
        player = Player(buffer)
        for _ in range(30):
            player.step()
    assert (buffers[0].sample(50).indices == buffers[1].sample(50).indices).all()
    copy = pickle.loads(pickle.dumps(buffers[0]))
    for _ in range(2):
        for ours, theirs in zip(buffers[0].sample(20), copy.sample(20), strict=True):
            for a, b in zip(
                *(x.values() if isinstance(x, dict) else [x] for x in (ours, theirs)), strict=True
            ):
                np.testing.assert_array_equal(a, b)
    player = Player(copy, seed=1)
    for _ in range(30):
        player.step()
    assert copy.sample(50).is_expert.any()


def test_pickle_holds_only_what_is_used() -> None:
    buffer = make_buffer(size=10_000)
    Player(buffer).step()
    assert len(pickle.dumps(buffer)) < 10_000


def test_reset_forgets_everything() -> None:
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
    ("kwargs", "message"),
    [
        ({"n_steps": 0}, "n_steps"),
        ({"n_steps": 3}, "gamma"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        (
            {"sampler": {"shares": {"expert_fraction": 1.5}}},
            "expert_fraction must be between 0 and 1, got 1.5",
        ),
        ({"sampler": "best"}, "sampler must be None, one of uniform, shares, prioritized, .* got 'best'"),
        ({"image_dtype": "float32"}, "dtype"),
        ({"size": 1}, "buffer_size"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(**kwargs)


def test_other_observation_spaces_are_refused() -> None:
    for space in (spaces.Discrete(3), spaces.Dict({"a": spaces.Discrete(3)})):
        with pytest.raises(ValueError, match="Box"):
            ExpertReplayBuffer(10, space, ACTION_SPACE)


@pytest.mark.parametrize(
    ("algorithm", "policy"), [(SAC, "MultiInputPolicy"), (TQC, "MultiInputPolicy"), (CrossQ, CrossQPolicy)]
)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_serves_stock_algorithms(algorithm: Any, policy: Any, n_envs: int, make_toy: Any) -> None:
    # CrossQ takes no Dict observations
    extractor = FlattenExtractor if policy is CrossQPolicy else CombinedExtractor

    def run() -> np.ndarray:
        model = algorithm(
            policy,
            make_toy(n_envs, image_only=policy is CrossQPolicy),
            learning_starts=10,
            buffer_size=30,
            batch_size=8,
            gamma=0.8,
            replay_buffer_class=ExpertReplayBuffer,
            policy_kwargs={"net_arch": [8], "features_extractor_class": extractor},
            seed=0,
        )
        model.learn(50)
        assert model.replay_buffer.sample(4).discounts is None  # so that the algorithm uses its own gamma
        return np.concatenate([p.detach().numpy().ravel() for p in model.actor.parameters()])

    np.testing.assert_array_equal(run(), run())


def test_vec_normalize(make_toy: Any) -> None:
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
