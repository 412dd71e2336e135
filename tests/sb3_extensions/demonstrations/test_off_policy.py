"""Base class of algorithms with demonstrations, tested with SACfD."""

from __future__ import annotations

import re

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC

from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.sacfd import SACfD


@pytest.mark.parametrize("steps", [None, 2, 6])
def test_a_loaded_model_begins_again_with_demonstrations_of_its_environment(
    steps, make_toy, make_learner, tmp_path
):
    """Also with fewer steps of pretraining than were done."""
    make_learner(pretrain_steps=4, critic_warmup_steps=2).learn(2).save(tmp_path / "model")
    changes = {} if steps is None else {"pretrain_steps": steps, "expert_episodes": 3}
    loaded = SACfD.load(tmp_path / "model", env=make_toy(max_steps=9), device="cpu", **changes)
    updates = loaded._n_updates
    loaded.learn(1)
    assert loaded.n_pretrained == (steps or 4) and loaded._n_updates >= updates + (steps or 4)
    assert loaded.replay_buffer is not None and loaded.replay_buffer.expert_size > 0


def test_the_replay_buffer_follows_the_discount(make_toy, make_learner, tmp_path):
    model = make_learner(gamma=0.9, n_steps=3).learn(10)
    buffer = model.replay_buffer
    assert (buffer.gamma, buffer.n_steps, model.n_steps) == (0.9, 3, 3)
    model.gamma, model.n_steps = 0.5, 2
    model.learn(1, reset_num_timesteps=False)
    assert (buffer.gamma, buffer.n_steps) == (0.5, 2)
    model.save(tmp_path / "model")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu", gamma=0.7, replay_buffer_kwargs={})
    assert loaded.replay_buffer is not None and loaded.replay_buffer.gamma == 0.7
    assert loaded.replay_buffer.n_steps == loaded.n_steps == 2
    loaded.learn(3)


def test_the_buffer_stores_what_the_extractor_rounds_to(make_learner):
    for quantise in ("uint8", "uint16"):
        extractor = {"channels": [4, 8, 8], "quantise": quantise}
        model = make_learner(policy_kwargs={"features_extractor_kwargs": extractor})
        assert model.replay_buffer.image_dtype == quantise


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


@pytest.mark.parametrize(
    ("n_envs", "changes", "message"),
    [
        (2, {}, "n_envs .* 1, got 2"),
        (1, {"image_dtype": "uint16"}, "image_dtype='uint16'"),
        (
            1,
            {"observation_space": spaces.Dict({"rgb": spaces.Box(0.0, 1.0, (1, 16, 16))})},
            "observation_space",
        ),
        (1, {"action_space": spaces.Box(-2.0, 2.0, (5,))}, "action_space"),
    ],
)
def test_a_replay_buffer_of_another_environment_is_rejected(
    n_envs, changes, message, make_toy, make_learner, tmp_path
):
    dtype = changes.get("image_dtype", "uint8")
    extractor = {"features_extractor_kwargs": {"channels": [4, 8, 8], "quantise": dtype}}
    other, model = make_learner(make_toy(n_envs), policy_kwargs=extractor), make_learner()
    for name, space in changes.items():
        if name.endswith("space"):
            setattr(other.replay_buffer, name, space)
            message = re.escape(f"{name} of the buffer must be {getattr(model, name)}, got {space}")
    other.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=message):
        model.learn(1)


def test_a_replay_buffer_of_another_class_is_rejected(make_toy, make_learner, tmp_path):
    stock = SAC("MultiInputPolicy", make_toy(), buffer_size=50, policy_kwargs={"net_arch": [4]})
    stock.save_replay_buffer(tmp_path / "buffer")
    model = make_learner()
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(AssertionError, match="ExpertReplayBuffer"):
        model.learn(1)
