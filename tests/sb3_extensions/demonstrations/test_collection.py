"""Collection of expert episodes, with noise and with actions on a grid."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_extensions.demonstrations.action_transforms import GaussianExpertNoise, GridSnapping
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec


def make_env(**kwargs) -> gym.Env[Any, Any]:
    return gym.make("ToyReach-v0", **kwargs)


def collect(episodes: int, seed: int | None = 0, env=None, transform=None) -> list[Any]:
    arguments = {"action_transform": transform, "progress_bar": False}
    return list(collect_episodes(env or make_env(), episodes, seed, **arguments))


def seeds(*args, **kwargs) -> list[int | None]:
    return [episode.seed for episode in collect(*args, **kwargs)]


def test_episodes_are_successes_that_their_seed_repeats():
    episodes = collect(5, env=make_env(expert_failures=3))
    assert len(episodes) == 5 and seeds(4) == seeds(4) != seeds(4, seed=1)
    for episode in episodes:
        n = len(episode.actions)
        assert episode.actions.shape == (n, 5) and n > 0
        assert episode.observations["heightmap"].shape == (n + 1, 1, 16, 16)
        assert episode.observations["holding"].shape == (n + 1, 1)
        assert episode.terminations.tolist() == [False] * (n - 1) + [True] and episode.rewards[-1] == 1
        assert episode.truncations.tolist() == [False] * n
        env = make_env()
        env.reset(seed=episode.seed)
        for k, action in enumerate(episode.actions):
            observation, reward, *_ = env.step(action)
            np.testing.assert_array_equal(observation["heightmap"], episode.observations["heightmap"][k + 1])
            assert reward == episode.rewards[k]


def test_only_the_first_episode_of_a_kept_scene_has_a_seed(monkeypatch):
    drawn = seeds(3)
    monkeypatch.setattr(type(make_env().unwrapped), "keeps_scene", True, raising=False)
    assert seeds(3) == [drawn[0], None, None]
    starts = [[each.observations["heightmap"][0].argmax() for each in collect(3)] for _ in range(2)]
    assert starts[0] == starts[1]
    assert len(set(starts[0])) == 3


class FailingOnce(gym.Wrapper[Any, Any, Any, Any]):
    """Whose second episode is never a success."""

    def __init__(self):
        super().__init__(make_env())
        self.seeds = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self.seeds.append(seed)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        *outcome, info = super().step(action)
        return *outcome, {**info, "is_success": info["is_success"] and len(self.seeds) != 2}


def test_failed_scene_is_reset(monkeypatch):
    monkeypatch.setattr(type(make_env().unwrapped), "keeps_scene", True, raising=False)
    env = FailingOnce()
    kept = seeds(3, env=env)
    first, second, after_failure, third, *rest = env.seeds  # a vector environment also resets at the end
    assert second is None and after_failure is None and third not in (None, first)
    assert rest == [None, None]
    assert kept == [first, third, None]


def test_noise_changes_executed_but_not_intended_actions():
    """The label of DART is the intended action in the state that results from earlier errors."""

    def noisily(noise: float) -> list[Any]:
        return collect(20, transform=GaussianExpertNoise(make_env().action_space, noise))

    noisy, again, steady = noisily(0.05), noisily(0.05), noisily(0.0)
    np.testing.assert_array_equal(noisy[0].actions, again[0].actions)
    assert noisy[0].actions.dtype == np.float32
    env, errors = make_env(), []
    for episode in noisy:
        env.reset(seed=episode.seed)
        for action, wanted in zip(episode.actions, episode.expert_actions, strict=True):
            np.testing.assert_array_equal(wanted, env.unwrapped.expert_action())
            errors.append(action - wanted)
            env.step(action)
        assert abs(episode.actions).max() <= 1.0
    inside = [error for error in np.concatenate(errors) if error]
    assert 0.02 < np.std(inside) < 0.06
    assert not np.array_equal(noisy[0].actions[0], steady[0].actions[0])
    np.testing.assert_array_equal(steady[0].actions, steady[0].expert_actions)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (4,), np.float32),
        spaces.Box(np.array([0.0, 2.0, -3.0, 0.0]), np.array([1.0, 2.4, 5.0, 3.2]), dtype=np.float64),
    ],
)
def test_nearest_actions_of_a_grid_in_the_units_of_the_environment(space):
    codec = SpatialActionCodec(24, "pxyr", num_rotations=4)
    transform, rng = GridSnapping(space, codec), np.random.default_rng(0)
    space.seed(0)
    for _ in range(50):
        wanted = space.sample()
        done = transform(wanted, rng)
        assert space.contains(done) and done.dtype == space.dtype
        share = (wanted - space.low) / (space.high - space.low)
        expected = codec.snap(2 * share[None] - 1)[0]
        np.testing.assert_allclose(2 * (done - space.low) / (space.high - space.low) - 1, expected, atol=1e-6)
        np.testing.assert_allclose(transform(done, rng), done, atol=1e-6)
    np.testing.assert_array_equal(transform(space.high + 1, rng), transform(space.high, rng))


class WithoutExpert(gym.Env[Any, Any]):
    observation_space = spaces.Dict({"a": spaces.Box(0, 1)})
    action_space = spaces.Box(-1, 1)


def test_environments_without_successes_or_expert_are_rejected():
    with pytest.raises(RuntimeError, match=r"0 of 8 episodes .*, 2 needed"):
        collect(2, env=make_env(expert_failures=100))
    with pytest.raises(ValueError, match="expert_action"):
        collect(1, env=WithoutExpert())


def test_an_observation_without_a_dict_has_one_key():
    heightmap = make_env().observation_space["heightmap"]
    env = gym.wrappers.TransformObservation(make_env(), lambda obs: obs["heightmap"], heightmap)
    [episode] = collect(1, env=env)
    assert episode.observations["observation"].shape == (len(episode.actions) + 1, 1, 16, 16)
