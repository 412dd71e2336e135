"""Environments of the expert: copies of the training environments with their wrappers."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, RecordEpisodeStatistics, TransformObservation
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)
from stable_baselines3.sac.policies import MultiInputPolicy as StockPolicy

from sb3_extensions.demonstrations import source
from sb3_extensions.demonstrations.expert_envs import make_expert_envs


def make_env(**kwargs) -> gym.Env[Any, Any]:
    return gym.make("ToyReach-v0", **kwargs)


class Halved(gym.ObservationWrapper[Any, Any, Any]):
    """Wrapper that a spec cannot create again."""

    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.factor = 0.5

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**observation, "heightmap": observation["heightmap"] * np.float32(self.factor)}


def stacked_and_unstacked(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    env = FrameStackObservation(env, 1)
    parts = {key: spaces.Box(0, 1, part.shape[1:]) for key, part in env.observation_space.spaces.items()}
    return TransformObservation(env, lambda obs: {k: v[0] for k, v in obs.items()}, spaces.Dict(parts))


def demonstrated(model, key: str = "heightmap") -> np.ndarray:
    """Return the stored images of the demonstrations."""
    table = model.learn(3).replay_buffer.table
    images = table.observations[key][: table.n_pinned]
    return images


def test_a_copy_has_the_wrappers_but_not_the_monitor(tmp_path):
    env = DummyVecEnv([lambda: Monitor(Halved(make_env(max_steps=7)), str(tmp_path / "log"))])
    [(copy, share)] = make_expert_envs(VecNormalize(env, norm_obs_keys=["holding"]))
    assert share == 1 and isinstance(copy, DummyVecEnv)
    assert isinstance(copy.envs[0], Halved) and copy.envs[0].unwrapped is not env.envs[0].unwrapped
    assert copy.envs[0].unwrapped.max_steps == 7
    env.reset()
    env.step(np.zeros((1, 5), np.float32))  # the monitor of the training still has its file
    assert env.envs[0].results_writer is not None


@pytest.mark.parametrize(
    ("wrapper", "highest"),
    [
        (Halved, 128),
        (lambda env: TransformObservation(env, lambda obs: obs, env.observation_space), 255),
        (RecordEpisodeStatistics, 255),
        (stacked_and_unstacked, 255 * 0.4),
    ],
)
def test_demonstrations_have_the_users_wrappers(wrapper, highest, make_learner):
    stored = demonstrated(make_learner(DummyVecEnv([lambda: wrapper(make_env())])))
    assert abs(int(stored.max()) - highest) <= 6


def test_stacked_frames_of_a_vector_environment(make_learner):
    env = VecFrameStack(DummyVecEnv([make_env, make_env]), 2, {"heightmap": "first", "holding": "last"})
    episode = demonstrated(make_learner(env))
    assert episode.shape[1:] == (2, 16, 16)
    assert not episode[0, 0].any()  # nothing before the first observation
    np.testing.assert_array_equal(episode[1, 0], episode[0, 1])


class Camera(gym.ObservationWrapper[Any, Any, Any]):
    """Add a camera of 8-bit images with the channels last, and a number without a shape."""

    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        parts = {"rgb": spaces.Box(0, 255, (20, 16, 3), np.uint8), "height": spaces.Box(0.0, 1.0, ())}
        self.observation_space = spaces.Dict(parts)

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        image = np.zeros((20, 16, 3), np.uint8)
        image[:16] = (observation["heightmap"][0] * 600).astype(np.uint8)[..., None]
        image[16:, :, 1] = 9
        return {"rgb": image, "height": np.float32(observation["heightmap"].max())}


class HeightExtractor(BaseFeaturesExtractor):
    """Extractor of the number without a shape."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 1)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return observations["height"].reshape(-1, 1)


def test_demonstrations_with_a_camera_and_a_number_without_a_shape(make_learner):
    env = DummyVecEnv([lambda: Camera(make_env())])
    model = make_learner(env, policy=StockPolicy, policy_kwargs={"features_extractor_class": HeightExtractor})
    stored = demonstrated(model, "rgb")
    assert isinstance(model.get_env(), VecTransposeImage)
    assert stored.shape[1:] == (3, 20, 16)
    assert (stored[:-1, 1, 16:] == 9).all() and not stored[:, 0, 16:].any()


@pytest.mark.parametrize("episodes, expected", [(6, [4, 2]), (1, [1, 0]), (5, [3, 2])])
def test_different_environments_contribute_in_proportion(episodes, expected, monkeypatch):
    env = DummyVecEnv([make_env, make_env, lambda: make_env(max_steps=50)])
    copies = make_expert_envs(env)
    assert [(copy.get_attr("max_steps")[0], share) for copy, share in copies] == [(10, 2), (50, 1)]
    counts = []
    monkeypatch.setattr(source, "collect_episodes", lambda env, n, *args, **kwargs: counts.append(n) or [])
    list(source.DemonstrationSource(episodes)._collect(env, 0))
    assert counts == expected


def test_environments_in_other_processes_come_from_their_spec():
    make = [lambda: Monitor(make_env(max_steps=7, render_mode="rgb_array"))] * 2
    env = SubprocVecEnv(make, start_method="fork")
    try:
        [(copy, share)] = make_expert_envs(env)
    finally:
        env.close()
    assert share == 2 and copy.get_attr("max_steps") == [7]
    assert copy.get_attr("render_mode") == [None]


class Uncopyable(gym.Wrapper[Any, Any, Any, Any]):
    spec = None

    def __deepcopy__(self, memo):
        raise TypeError("no copies")


class UnknownWrapper(VecEnvWrapper):
    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


def test_env_that_cannot_be_copied_is_rejected_with_advice():
    with pytest.raises(ValueError, match=r"env .*expert_data=collect_episodes"):
        make_expert_envs(DummyVecEnv([lambda: Uncopyable(make_env())]))
    with pytest.raises(ValueError, match=r"env .*UnknownWrapper.*expert_data"):
        make_expert_envs(UnknownWrapper(DummyVecEnv([make_env])))
