"""Environments of the expert: copies of the training environments with their wrappers."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, TransformObservation
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
from sb3_extensions.sacfd import SACfD

ENV_ID = "ToyReach-v0"


def make_env(**kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make(ENV_ID, **kwargs)


class Halved(gym.ObservationWrapper[Any, Any, Any]):
    """Wrapper that a spec cannot create again."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.factor = 0.5

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**observation, "heightmap": observation["heightmap"] * np.float32(self.factor)}


def learn(env: Any, **kwargs: Any) -> SACfD:
    small = {"features_extractor_kwargs": {"channels": [4, 8, 8]}, "net_arch": [16]}
    arguments = {"expert_episodes": 4, "batch_size": 8, "buffer_size": 400, "policy_kwargs": small, **kwargs}
    return SACfD("MultiInputPolicy", env, seed=0, device="cpu", **arguments).learn(4)


def test_a_copy_has_the_wrappers_but_not_the_monitor(tmp_path: Any) -> None:
    env = DummyVecEnv([lambda: Monitor(Halved(make_env(max_steps=7)), str(tmp_path / "log"))])
    [(copy, share)] = make_expert_envs(env)
    assert share == 1 and isinstance(copy, DummyVecEnv)
    assert isinstance(copy.envs[0], Halved) and copy.envs[0].unwrapped is not env.envs[0].unwrapped
    assert copy.envs[0].unwrapped.max_steps == 7
    env.reset()
    env.step(np.zeros((1, 5), np.float32))  # the monitor of the training still has its file
    assert env.envs[0].results_writer is not None


@pytest.mark.parametrize(
    "wrapper",
    [
        Halved,
        lambda env: TransformObservation(env, lambda obs: obs, env.observation_space),
        gym.wrappers.RecordEpisodeStatistics,
        lambda env: FrameStackObservation(env, 1),
    ],
)
def test_demonstrations_have_the_users_wrappers(wrapper: Any) -> None:
    def make() -> Any:
        env = wrapper(make_env())
        if isinstance(env, FrameStackObservation):
            flat = {k: s.shape[1:] for k, s in env.observation_space.spaces.items()}
            space = spaces.Dict({k: spaces.Box(0, 1, shape) for k, shape in flat.items()})
            env = TransformObservation(env, lambda obs: {k: v[0] for k, v in obs.items()}, space)
        return env

    vec_env = DummyVecEnv([make])
    model = learn(vec_env)
    assert model.replay_buffer is not None and model.replay_buffer.expert_size > 0
    stored = model.replay_buffer.table.observations["heightmap"][: model.replay_buffer.table.n_pinned]
    expected = 128 if wrapper is Halved else 255
    if isinstance(vec_env.observation_space["heightmap"], spaces.Box) and wrapper is not Halved:
        expected = round(255 * 0.4 / vec_env.observation_space["heightmap"].high.max())
    assert abs(int(stored.max()) - expected) <= 6


def test_stacked_frames_of_a_vector_environment() -> None:
    env = VecFrameStack(DummyVecEnv([make_env, make_env]), 2, {"heightmap": "first", "holding": "last"})
    model = learn(env)
    assert model.replay_buffer is not None
    table = model.replay_buffer.table
    episode = table.observations["heightmap"][: table.n_pinned]
    assert episode.shape[1:] == (2, 16, 16)
    assert not episode[0, 0].any()  # nothing before the first observation
    np.testing.assert_array_equal(episode[1, 0], episode[0, 1])


class Camera(gym.ObservationWrapper[Any, Any, Any]):
    """Add a camera of 8-bit images with the channels last, and a number without a shape."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
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

    def __init__(self, observation_space: Any) -> None:
        super().__init__(observation_space, 1)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return observations["height"].reshape(-1, 1)


def test_demonstrations_with_a_camera_and_a_number_without_a_shape() -> None:
    env = DummyVecEnv([lambda: Camera(make_env())])
    model = SACfD(
        StockPolicy,
        env,
        expert_episodes=2,
        batch_size=4,
        buffer_size=100,
        policy_kwargs={"net_arch": [8], "features_extractor_class": HeightExtractor},
    ).learn(3)
    assert isinstance(model.get_env(), VecTransposeImage)
    assert model.replay_buffer is not None
    stored = model.replay_buffer.table.observations["rgb"][: model.replay_buffer.table.n_pinned]
    assert stored.shape[1:] == (3, 20, 16)
    assert (stored[:-1, 1, 16:] == 9).all() and not stored[:, 0, 16:].any()


def test_different_environments_contribute_in_proportion() -> None:
    sizes = [0.0, 0.0, 1.0]

    def make(index: int) -> Any:
        return lambda: make_env(max_steps=50 if sizes[index] else 10)

    env = DummyVecEnv([make(index) for index in range(3)])
    copies = make_expert_envs(env)
    assert [(copy.get_attr("max_steps")[0], share) for copy, share in copies] == [(10, 2), (50, 1)]


@pytest.mark.parametrize("episodes, expected", [(6, [4, 2]), (1, [1, 0]), (5, [3, 2])])
def test_shares_of_the_episodes(episodes: int, expected: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[int] = []
    monkeypatch.setattr(source, "collect_episodes", lambda env, n, *args, **kwargs: counts.append(n) or [])
    env = DummyVecEnv([make_env, make_env, lambda: make_env(max_steps=50)])
    list(source.DemonstrationSource(episodes)._collect(env, 0))
    assert counts == expected


def test_environments_in_other_processes_come_from_their_spec() -> None:
    env = SubprocVecEnv(
        [lambda: Monitor(make_env(max_steps=7, render_mode="rgb_array"))] * 2, start_method="fork"
    )
    try:
        [(copy, share)] = make_expert_envs(env)
    finally:
        env.close()
    assert share == 2 and copy.get_attr("max_steps") == [7]
    assert copy.get_attr("render_mode") == [None]


def test_expert_envs_have_no_vec_normalize() -> None:
    [(copy, _)] = make_expert_envs(VecNormalize(DummyVecEnv([make_env]), norm_obs_keys=["holding"]))
    assert isinstance(copy, DummyVecEnv)


def test_env_that_cannot_be_copied_is_rejected_with_advice() -> None:
    class Uncopyable(gym.Wrapper[Any, Any, Any, Any]):
        spec = None  # type: ignore[assignment]

        def __deepcopy__(self, memo: Any) -> Any:
            raise TypeError("no copies")

    with pytest.raises(
        ValueError, match=r"env must be copyable or have a spec, .*expert_data=collect_episodes"
    ):
        make_expert_envs(DummyVecEnv([lambda: Uncopyable(make_env())]))

    class Unknown(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            return self.venv.step_wait()

    with pytest.raises(
        ValueError, match=r"env must have known vector wrappers, got Unknown\. Pass expert_data"
    ):
        make_expert_envs(Unknown(DummyVecEnv([make_env])))
