"""Collection of expert episodes, with noise and on a grid, in copies of the training environments."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, TransformObservation
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from bulletarm_gym.demonstrations import RecordDemonstrations
from sb3_extensions.demonstrations import expert_envs
from sb3_extensions.demonstrations.collection import add_noise, collect_episodes
from sb3_extensions.demonstrations.expert_envs import make_expert_envs


def make_env(**kwargs):
    return gym.make("ToyReach-v0", **kwargs)


def collect(episodes, seed=0, env=None, transform=None):
    arguments = {"action_transform": transform, "progress_bar": False}
    return list(collect_episodes(env or make_env(), episodes, seed, **arguments))


def seeds(*args, **kwargs):
    return [episode.seed for episode in collect(*args, **kwargs)]


def test_episodes_are_successes_that_their_seed_repeats():
    episodes = collect(5, env=make_env(expert_failures=3))
    assert len(episodes) == 5 and seeds(4) == seeds(4) != seeds(4, seed=1)
    for episode in episodes:
        n = len(episode.actions)
        assert episode.actions.shape == (n, 5) and n > 0
        assert episode.terminations.tolist() == [False] * (n - 1) + [True]
        assert episode.truncations.tolist() == [False] * n
        env = make_env()
        env.reset(seed=episode.seed)
        steps = [env.step(action) for action in episode.actions]
        np.testing.assert_array_equal([step[1] for step in steps], episode.rewards)
        for name, values in episode.observations.items():
            np.testing.assert_array_equal([step[0][name] for step in steps], values[1:])


class FailingOnce(gym.Wrapper[Any, Any, Any, Any]):
    """Whose second episode is never a success."""

    def __init__(self):
        super().__init__(make_env())
        self.seeds = []

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        *outcome, info = super().step(action)
        return *outcome, {**info, "is_success": info["is_success"] and len(self.seeds) != 2}


def test_a_kept_scene_is_reset_after_a_failure_only(monkeypatch):
    """Only the first episode of a scene has a seed."""
    monkeypatch.setattr(type(make_env().unwrapped), "keeps_scene", True, raising=False)
    env = FailingOnce()
    kept = seeds(3, env=env)
    first, second, after_failure, third, *rest = env.seeds  # a vector environment also resets at the end
    assert second is None and after_failure is None and third not in (None, first)
    assert rest == [None, None] and kept == [first, third, None]


def test_noise_changes_executed_but_not_intended_actions():
    """The label of DART is the intended action in the state that results from earlier errors."""
    transform = partial(add_noise, space=make_env().action_space, std=0.05)
    noisy, again = (collect(20, transform=transform) for _ in range(2))
    np.testing.assert_array_equal(noisy[0].actions, again[0].actions)
    env, errors = make_env(), []
    for episode in noisy:
        env.reset(seed=episode.seed)
        for action, wanted in zip(episode.actions, episode.expert_actions, strict=True):
            np.testing.assert_array_equal(wanted, env.unwrapped.expert_action())
            errors.append(action - wanted)
            env.step(action)
        assert abs(episode.actions).max() <= 1.0 and episode.actions.dtype == np.float32
    assert 0.02 < np.std([error for error in np.concatenate(errors) if error]) < 0.06


def test_environments_without_successes_or_expert_are_rejected():
    with pytest.raises(RuntimeError, match=r"0 of 8 episodes .*, 2 needed"):
        collect(2, env=make_env(expert_failures=100))
    with pytest.raises(ValueError, match="expert_action"):
        collect(1, env=gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match=r"env must be one environment, got .* 2"):
        collect(1, env=DummyVecEnv([make_env] * 2))


class Halved(gym.ObservationWrapper[Any, Any, Any]):
    """Wrapper that a spec cannot create again."""

    def observation(self, observation):
        return {**observation, "heightmap": observation["heightmap"] * np.float32(0.5)}


def stacked_and_unstacked(env):
    env = FrameStackObservation(env, 1)
    parts = {key: spaces.Box(0, 1, part.shape[1:]) for key, part in env.observation_space.spaces.items()}
    return TransformObservation(env, lambda obs: {k: v[0] for k, v in obs.items()}, spaces.Dict(parts))


def demonstrated(model, key="heightmap"):
    """Return the stored images of the demonstrations."""
    table = model.learn(3).replay_buffer.table
    return table.observations[key][: table.n_pinned]


def test_a_copy_has_the_wrappers_but_not_the_monitor(tmp_path):
    env = DummyVecEnv([lambda: Monitor(Halved(make_env(max_steps=7)), str(tmp_path / "log"))])
    [(copy, share)] = make_expert_envs(VecNormalize(env, norm_obs_keys=["holding"]))
    assert share == 1 and isinstance(copy, DummyVecEnv) and isinstance(copy.envs[0], Halved)
    assert copy.envs[0].unwrapped is not env.envs[0].unwrapped and copy.envs[0].unwrapped.max_steps == 7
    env.reset()
    env.step(np.zeros((1, 5), np.float32))  # the monitor of the training still has its file
    assert env.envs[0].results_writer is not None


@pytest.mark.parametrize("kind", [DummyVecEnv, partial(SubprocVecEnv, start_method="fork")])
def test_demonstrations_of_a_training_are_not_recorded(kind, tmp_path):
    path = tmp_path / "own.h5"
    env_id = "BulletArm/CloseLoopBlockReaching-v0"
    env = kind([lambda: RecordDemonstrations(gym.make(env_id, obs_size=16), path)])
    [(copy, _)] = make_expert_envs(env)
    assert len(collect(1, env=copy)) == 1
    copy.close()
    env.close()
    assert not path.exists()


def test_demonstrations_have_the_users_wrappers(make_learner):
    stored = demonstrated(make_learner(DummyVecEnv([lambda: stacked_and_unstacked(make_env())])))
    assert abs(stored.max() - 255 * 0.4) <= 6


def test_stacked_frames_of_a_vector_environment(make_learner):
    env = VecFrameStack(DummyVecEnv([make_env, make_env]), 2, {"heightmap": "first", "holding": "last"})
    episode = demonstrated(make_learner(env))
    assert episode.shape[1:] == (2, 16, 16)
    assert not episode[0, 0].any()  # nothing before the first observation
    np.testing.assert_array_equal(episode[1, 0], episode[0, 1])


class Camera(gym.ObservationWrapper):
    """Images of 8 bits with the channels last."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"rgb": spaces.Box(0, 255, (16, 16, 3), np.uint8)})

    def observation(self, observation):
        image = (observation["heightmap"][0] * 600).astype(np.uint8)
        return {"rgb": np.stack([image, np.full_like(image, 9), image], axis=-1)}


def test_demonstrations_with_a_camera(make_learner):
    model = make_learner(DummyVecEnv([lambda: Camera(make_env())]))
    stored = demonstrated(model, "rgb")
    assert isinstance(model.get_env(), VecTransposeImage) and stored.shape[1:] == (3, 16, 16)
    assert (stored[:-1, 1] == 9).all() and stored[:, 0].any()


@pytest.mark.parametrize("episodes, expected", [(6, [4, 2]), (1, [1, 0]), (5, [3, 2])])
def test_different_environments_contribute_in_proportion(episodes, expected, monkeypatch):
    env = DummyVecEnv([make_env, make_env, lambda: make_env(max_steps=50)])
    copies = make_expert_envs(env)
    assert [(copy.get_attr("max_steps")[0], share) for copy, share in copies] == [(10, 2), (50, 1)]
    counts = []
    monkeypatch.setattr(
        expert_envs, "collect_episodes", lambda env, n, *args, **kwargs: counts.append(n) or []
    )
    list(expert_envs.collect_from_copies(env, episodes, 0))
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


def test_environments_with_arrays_in_their_spec():
    """They count as different, because arrays have no single truth value."""
    make = partial(make_env, max_steps=np.array([7, 7]))
    assert [share for _, share in make_expert_envs(DummyVecEnv([make] * 2))] == [1, 1]


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
