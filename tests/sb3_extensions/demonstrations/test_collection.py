"""Collection of expert episodes."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_extensions.demonstrations.action_transforms import GaussianExpertNoise
from sb3_extensions.demonstrations.collection import collect_episodes

ENV_ID = "ToyReach-v0"


def make_env(**kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make(ENV_ID, **kwargs)


def test_collect_episodes_returns_successes_only() -> None:
    env = make_env(expert_failures=3)
    episodes = list(collect_episodes(env, 5, seed=0, progress_bar=False))
    assert len(episodes) == 5
    assert all(len(episode.actions) > 0 for episode in episodes)
    assert all(episode.terminations[-1] and episode.rewards[-1] == 1 for episode in episodes)


def test_shape_of_an_episode() -> None:
    episode = next(collect_episodes(make_env(), 1, seed=0, progress_bar=False))
    n = len(episode.actions)
    assert episode.actions.shape == (n, 5)
    assert episode.observations["heightmap"].shape == (n + 1, 1, 16, 16)
    assert episode.observations["holding"].shape == (n + 1, 1)
    for array in (episode.rewards, episode.terminations, episode.truncations):
        assert array.shape == (n,)
    assert not episode.terminations[:-1].any() and not episode.truncations.any()
    # The episode can be played again from its seed.
    env = make_env()
    env.reset(seed=episode.seed)
    for k, action in enumerate(episode.actions):
        observation, reward, *_ = env.step(action)
        np.testing.assert_array_equal(observation["heightmap"], episode.observations["heightmap"][k + 1])
        assert reward == episode.rewards[k]


def test_same_seed_same_episodes() -> None:
    def seeds(seed: int) -> list[int | None]:
        return [episode.seed for episode in collect_episodes(make_env(), 4, seed, progress_bar=False)]

    assert seeds(1) == seeds(1) != seeds(2)
    assert len(set(seeds(1))) == 4


def test_only_the_first_episode_of_a_kept_scene_has_a_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    def seeds() -> list[int | None]:
        return [episode.seed for episode in collect_episodes(make_env(), 3, 0, progress_bar=False)]

    drawn = seeds()
    monkeypatch.setattr(type(make_env().unwrapped), "keeps_scene", True, raising=False)
    assert seeds() == [drawn[0], None, None]
    starts = [
        [
            episode.observations["heightmap"][0].argmax()
            for episode in collect_episodes(make_env(), 3, 0, progress_bar=False)
        ]
        for _ in range(2)
    ]
    assert starts[0] == starts[1]
    assert len(set(starts[0])) == 3


def test_failed_scene_is_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unlucky(gym.Wrapper[Any, Any, Any, Any]):
        """Whose second episode is never a success."""

        def __init__(self) -> None:
            super().__init__(make_env())
            self.seeds: list[int | None] = []

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            self.seeds.append(seed)
            return super().reset(seed=seed, options=options)

        def step(self, action: Any) -> Any:
            *outcome, info = super().step(action)
            return *outcome, {**info, "is_success": info["is_success"] and len(self.seeds) != 2}

    monkeypatch.setattr(type(make_env().unwrapped), "keeps_scene", True, raising=False)
    env = Unlucky()
    episodes = list(collect_episodes(env, 3, 0, progress_bar=False))
    first, second, after_failure, third, *rest = env.seeds  # a vector environment also resets at the end
    assert second is None and after_failure is None and third not in (None, first)
    assert rest == [None, None]
    assert [episode.seed for episode in episodes] == [first, third, None]


def test_noise_changes_executed_but_not_intended_actions() -> None:
    """The label of DART is the intended action in the state that results from earlier errors."""

    def collect(noise: float) -> list[Any]:
        noise_transform = GaussianExpertNoise(make_env().action_space, noise)
        return list(collect_episodes(make_env(), 20, 0, progress_bar=False, action_transform=noise_transform))

    noisy, again, steady = collect(0.05), collect(0.05), collect(0.0)
    assert [episode.seed for episode in noisy] == [episode.seed for episode in again]
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
    assert noisy[0].seed == steady[0].seed
    np.testing.assert_array_equal(steady[0].actions, steady[0].expert_actions)


def test_action_transform_changes_executed_actions() -> None:
    def snap(action: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.round(action * 2) / 2

    for episode in collect_episodes(make_env(), 5, 0, progress_bar=False, action_transform=snap):
        np.testing.assert_array_equal(episode.actions, np.round(episode.expert_actions * 2) / 2)
        env = make_env()
        env.reset(seed=episode.seed)
        for k, action in enumerate(episode.actions):
            observation, *_ = env.step(action)
            np.testing.assert_array_equal(observation["heightmap"], episode.observations["heightmap"][k + 1])


def test_collect_episodes_raises_after_too_many_failures() -> None:
    episodes = collect_episodes(make_env(expert_failures=100), 2, seed=0, progress_bar=False)
    with pytest.raises(RuntimeError, match=r"succeeded in 0 of 8 episodes .*, 2 needed"):
        list(episodes)


def test_collect_episodes_rejects_env_without_expert() -> None:
    with pytest.raises(ValueError, match="expert_action"):
        next(collect_episodes(_WithoutExpert(), 1))


class _WithoutExpert(gym.Env[Any, Any]):
    observation_space = gym.spaces.Dict({"a": gym.spaces.Box(0, 1)})
    action_space = gym.spaces.Box(-1, 1)


def test_an_observation_without_a_dict_has_one_key() -> None:
    env = gym.wrappers.TransformObservation(
        make_env(), lambda obs: obs["heightmap"], make_env().observation_space["heightmap"]
    )
    episode = next(collect_episodes(env, 1, seed=0, progress_bar=False))
    assert episode.observations["observation"].shape == (len(episode.actions) + 1, 1, 16, 16)
