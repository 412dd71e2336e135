"""Demonstrations that users pass and replay buffers of loaded models: accepted forms and refusals."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, RescaleAction
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from bulletarm_gym.demonstrations import collect
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.dagger import DaggerCallback
from sb3_extensions.demonstrations.episodes import Episode
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.demonstrations.validation import load_episodes
from sb3_extensions.sacfd import SACfD


@pytest.mark.parametrize("steps", [None, 2])
def test_a_loaded_model_begins_again_with_demonstrations_of_its_environment(
    steps, make_toy, make_learner, tmp_path
):
    """Also with fewer steps of pretraining than were done, with action noise of more environments, and with
    a learning rate that has decreased to 0."""
    kwargs = {"action_noise": NormalActionNoise(np.zeros(5), np.ones(5)), "pretrain_steps": 4}
    kwargs |= {"learning_rate": lambda remaining: 1e-3 * remaining, "learning_starts": 2}
    make_learner(make_toy(2), critic_warmup_steps=2, **kwargs).learn(2).save(tmp_path / "model")
    changes = {} if steps is None else {"pretrain_steps": steps, "expert_episodes": 3}
    loaded = SACfD.load(tmp_path / "model", env=make_toy(max_steps=9), device="cpu", **changes)
    updates = loaded._n_updates
    loaded.learn(1)
    assert loaded.actor.optimizer.param_groups[0]["lr"] == 1e-3  # of the pretraining, the latest updates
    assert loaded.n_pretrained == (steps or 4) and loaded._n_updates >= updates + (steps or 4)
    assert loaded.replay_buffer is not None and loaded.replay_buffer.expert_size > 0


def test_an_interrupted_pretraining_can_be_shortened(make_learner):
    model = make_learner(pretrain_steps=9, learning_starts=9)

    class Interruption(BaseCallback):
        def _on_rollout_start(self):
            if model.n_pretrained == 3:
                raise KeyboardInterrupt

        def _on_step(self):
            return True

    with pytest.raises(KeyboardInterrupt):
        model.learn(1, callback=Interruption())
    model.pretrain_steps = 2
    model.learn(1)
    assert model.n_pretrained == 3 and model.replay_buffer.size() == model.replay_buffer.expert_size + 1


def test_training_after_a_stop_at_the_end_of_an_episode_stores_steps_of_one_episode(make_toy, make_learner):
    env = make_toy(2, max_steps=3, observation="state")
    model = make_learner(env, policy="StatePolicy", expert_episodes=0, learning_starts=99)
    model.learn(50, callback=StopTrainingOnMaxEpisodes(1))
    model.learn(8, reset_num_timesteps=False)
    sample = model.replay_buffer.sample(50)
    moved = (sample.observations["state"] - 0.3 * sample.actions[:, 1:3]).clip(-1, 1)
    np.testing.assert_allclose(sample.next_observations["state"], moved, atol=1e-6)


def test_the_replay_buffer_follows_the_discount(make_toy, make_learner, tmp_path):
    model = make_learner(gamma=0.9, n_steps=3).learn(10)
    buffer = model.replay_buffer
    assert (buffer.gamma, buffer.n_steps, model.n_steps) == (0.9, 3, 3)
    model.gamma, model.n_steps = 0.5, 2
    model.learn(1, reset_num_timesteps=False)
    assert (buffer.gamma, buffer.n_steps) == (0.5, 2)
    model.save(tmp_path / "model")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu", gamma=0.7, replay_buffer_kwargs={})
    assert (loaded.replay_buffer.gamma, loaded.replay_buffer.n_steps, loaded.n_steps) == (0.7, 2, 2)
    loaded.learn(3)


def test_interrupted_collection_starts_again(make_learner, monkeypatch):
    whole, model = make_learner().learn(3), make_learner()
    add, added = model.replay_buffer.add_episode, []

    def interrupted(*args, **kwargs):
        add(*args, **kwargs)
        added.append(args)
        if len(added) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(model.replay_buffer, "add_episode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(3)
    assert model.replay_buffer.size() == 0
    model.learn(3)
    assert model.replay_buffer.expert_size == whole.replay_buffer.expert_size


def test_loaded_model_requires_expert_data_again(make_toy, make_learner, tmp_path):
    data = list(collect_episodes(make_expert_envs(make_toy())[0][0], 2, seed=0, progress_bar=False))
    model = make_learner(expert_data=iter(data)).learn(2)
    stored = model.replay_buffer.steps("action")[: model.replay_buffer.expert_size]
    np.testing.assert_allclose(stored, np.concatenate([episode.actions for episode in data]), atol=1e-6)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu")
    assert loaded.expert_data is None
    with pytest.raises(ValueError, match=r"expert_data .*, got None"):
        loaded.learn(2)
    loaded.expert_data = data
    loaded.learn(2)
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.learn(2).replay_buffer.expert_size == model.replay_buffer.expert_size


COLOUR = spaces.Dict({"rgb": spaces.Box(0.0, 1.0, (1, 16, 16))})


@pytest.mark.parametrize(
    ("n_envs", "dtype", "attributes", "message"),
    [
        (2, "uint8", {}, "n_envs .* 1, got 2"),
        (1, "uint16", {}, "image_dtype='uint16'"),
        (1, "uint8", {"observation_space": COLOUR}, "observation_space of the buffer must be .* got .*rgb"),
        (1, "uint8", {"action_space": spaces.Box(-2.0, 2.0, (5,))}, "action_space of .* got .*2.0"),
    ],
)
def test_a_replay_buffer_of_another_environment_is_rejected(
    n_envs, dtype, attributes, message, make_toy, make_learner, tmp_path
):
    extractor = {"features_extractor_kwargs": {"channels": [4, 8, 8], "quantise": dtype}}
    other, model = make_learner(make_toy(n_envs), policy_kwargs=extractor), make_learner()
    vars(other.replay_buffer).update(attributes)
    other.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=message):
        model.learn(1)


ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
OTHER_ID = "BulletArm/CloseLoopBlockPicking-v0"
PARTS = ("observations", "actions", "rewards", "terminations")


@pytest.fixture(scope="module")
def reaching():
    return collect(ENV_ID, 1, seed=0, env_kwargs={"observation": "state"})


class MinariLike(list[Any]):
    """Episodes with the attributes of a Minari data set."""

    action_ranges = None

    def __init__(self, episodes, **kwargs):
        super().__init__(episodes)
        self.env_spec = SimpleNamespace(id=kwargs.pop("id", ENV_ID), kwargs=kwargs)
        self.action_space = spaces.Box(-1.0, 1.0, (5,), np.float32)


def learn(data, env=None, policy="StatePolicy", **env_kwargs):
    """Return the replay buffer after a step; refused demonstrations leave it empty."""
    env = env or make_vec_env(ENV_ID, env_kwargs={"observation": "state", **env_kwargs})
    model = SACfD(policy, env, expert_data=data, buffer_size=100, seed=0)
    try:
        return model.learn(1).replay_buffer
    except ValueError:
        assert model.replay_buffer.size() == 0
        raise


def test_a_stock_replay_buffer_is_rejected(make_learner, tmp_path):
    stock = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")
    stock.save_replay_buffer(tmp_path / "buffer")
    model = make_learner()
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=r"replay_buffer must be an ExpertReplayBuffer, got .*ReplayBuffer"):
        model.learn(1)


def plain_episode(episode, **changes):
    parts = {name: getattr(episode, name) for name in (*PARTS, "truncations", "seed")}
    return dataclasses.replace(Episode(**parts, expert_actions=episode.actions), **changes)


def rescaled(low, high):
    env = gym.make(ENV_ID, observation="state")
    return make_vec_env(lambda: RescaleAction(env, np.float32(low), np.float32(high)))


def test_forms_of_expert_data(reaching, tmp_path):
    """Demonstrations, files, episodes with Minari's attributes, iterators, and further observations."""
    path = tmp_path / "reaching.h5"
    reaching.save(path)
    more = {**reaching[0].observations, "more": np.zeros((len(reaching[0]) + 1, 2))}
    few = SimpleNamespace(**{name: getattr(reaching[0], name) for name in PARTS})
    minari = MinariLike(reaching, action_sequence="pxyzr")
    further = [plain_episode(reaching[0], observations=more)]
    actions = []
    for data in (reaching, path, str(path), minari, iter([few]), further):
        buffer = learn(data)
        assert buffer.expert_size == len(reaching[0])
        actions.append(buffer.steps("action")[: buffer.expert_size])
    assert all(np.array_equal(actions[0], other) for other in actions[1:])


def test_expert_data_of_a_box_space_are_arrays(reaching):
    env = make_vec_env(lambda: FlattenObservation(gym.make(ENV_ID, observation="state")))
    space = gym.make(ENV_ID, observation="state").observation_space
    parts = reaching[0].observations
    flat = np.concatenate([np.asarray(parts[name], np.float32) for name in space], axis=1)
    columns = {name: getattr(reaching[0], name) for name in PARTS}
    for observations in (flat, {"observation": flat}):
        buffer = learn([SimpleNamespace(**{**columns, "observations": observations})], env)
        stored = buffer.table.observations["observation"][: len(flat)]
        np.testing.assert_array_equal(stored, flat)


def test_expert_data_without_episodes_is_refused(reaching, tmp_path):
    used = iter([plain_episode(reaching[0])])
    learn(used)
    for data in ([], used):
        with pytest.raises(ValueError, match=r"expert_data .*, got none"):
            learn(data)
    with pytest.raises(ValueError, match=r"expert_data .* got 3"):
        load_episodes(3)
    (tmp_path / "other.h5").write_bytes(b"other")
    with pytest.raises(ValueError, match=r"other\.h5"):
        learn(tmp_path / "other.h5")
    with pytest.raises(FileNotFoundError, match=r"none\.h5"):
        learn(tmp_path / "none.h5")


def test_demonstrations_of_other_actions_are_refused(reaching):
    with pytest.raises(ValueError, match=r"^expert_data must have action_sequence='xyzrp'.*'pxyzr'$"):
        learn(reaching, action_sequence="xyzrp")
    with pytest.raises(ValueError, match="got 'pxyz'"):
        learn(MinariLike(reaching, action_sequence="pxyz"))
    data = MinariLike(reaching)
    data.action_ranges = {**(reaching.action_ranges or {}), "x": (0.0, 1.0)}
    with pytest.raises(ValueError, match=r"^expert_data must have action_ranges=.* got .*\(0\.0, 1\.0\)"):
        learn(data)
    with pytest.raises(ValueError, match=r"action_space=Box\(0\.0, 1\.0.*got Box\(-1\.0, 1\.0"):
        learn(reaching, rescaled(0.0, 1.0))


def test_demonstrations_of_another_task_are_refused():
    picking = collect(OTHER_ID, 1, seed=0, env_kwargs={"obs_size": 48})
    kwargs = {"policy": "MultiInputPolicy", "observation": "image", "obs_size": 48}
    for data in (picking, MinariLike(picking, id=OTHER_ID)):
        with pytest.raises(ValueError, match=f"^expert_data .*{ENV_ID}, got episodes of {OTHER_ID}"):
            learn(data, **kwargs)
    learn(list(picking), **kwargs)  # episodes alone have no environment


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("actions", lambda x: x[:, :4], r"actions of shape \(\d+, 5\), got \(\d+, 4\)"),
        ("actions", lambda x: None, r"actions of shape \(1, 5\), got \(\)"),
        ("actions", lambda x: x[:0], "at least one step .* got 0 in episode 1"),
        ("observations", lambda x: x["state"], r"keys \['holding', 'state'\], got ndarray"),
        ("observations", lambda x: {"other": x["state"]}, r"keys \['holding', 'state'\], got \['other'\]"),
        ("observations", lambda x: {**x, "state": x["state"][:, :3]}, r"observations\['state'\] of .*3\)"),
        ("observations", lambda x: {**x, "state": x["state"][1:]}, r"observations\['state'\] of shape"),
        ("observations", lambda x: {**x, "holding": x["holding"] - 3}, r"observations\['holding'\] .* -3"),
        ("terminations", lambda x: [True, *x[1:]], r"terminations .*, got one at step 0 of \d+ in episode 1"),
        ("terminations", lambda x: x[1:], r"terminations of shape \(\d+,\), got"),
        ("rewards", lambda x: x[:-1], r"rewards of shape \(\d+,\), got \(\d+,\) in episode 1"),
        ("rewards", lambda x: [None] * len(x), "rewards of a type .* float32, got object in episode 1"),
        ("rewards", lambda x: [[1.0], [2.0, 3.0]], "rewards, .*inhomogeneous.* in episode 1"),
        ("rewards", lambda x: x + np.inf, "rewards from .* got inf to inf in episode 1"),
        ("actions", lambda x: x * 1000, r"actions from -1 to 1, got -?\d+ to \d+ in episode 1"),
        ("actions", lambda x: np.full_like(x, np.nan), "actions from -1 to 1, got nan to nan in episode 1"),
        ("expert_actions", lambda x: x - 7, "expert_actions from -1 to 1, got -8"),
    ],
)
def test_shapes_and_values_outside_their_bounds_are_refused(name, change, message, reaching):
    episode = plain_episode(reaching[0])
    wrong = dataclasses.replace(episode, **{name: change(getattr(episode, name))})
    with pytest.raises(ValueError, match=f"^expert_data must have .*{message}"):
        learn([episode, wrong])


@pytest.mark.parametrize("form", [vars, lambda episode: None, lambda episode: [episode]])
def test_episodes_without_attributes_are_refused(form, reaching):
    episode = plain_episode(reaching[0])
    with pytest.raises(ValueError, match=r"^expert_data .* attribute 'observations', got \w+ in episode 0"):
        learn([form(episode)])


def test_floats_are_refused_for_images_of_integers(make_toy, make_learner):
    env = make_toy()
    [episode] = collect_episodes(make_expert_envs(env)[0][0], 1, seed=0, progress_bar=False)
    env.observation_space["heightmap"] = spaces.Box(0, 255, (1, 16, 16), np.uint8)
    model = make_learner(env, expert_data=[episode])
    with pytest.raises(ValueError, match=r"observations\['heightmap'\] .* uint8, got float32"):
        model.learn(1)


def test_learner_stores_the_experts_actions_in_the_wrapped_action_space():
    """Of demonstrations, and of a step with DAgger."""
    stored = []
    for env in (make_vec_env(ENV_ID, env_kwargs={"observation": "state"}), rescaled(-2.0, 5.0)):
        model = SACfD("StatePolicy", env, expert_episodes=2, expert_noise=0.05, buffer_size=100, seed=0)
        buffer = model.learn(2, callback=DaggerCallback()).replay_buffer
        executed, intended = (buffer.steps(name) for name in ("action", "expert_action"))
        assert np.abs(executed - intended)[: buffer.expert_size].max() > 0.02
        stored.append(intended[: buffer.expert_size + 1])
    np.testing.assert_allclose(stored[0], stored[1], atol=1e-5)
