"""Base class of algorithms with demonstrations, tested with SACfD."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.common.checkpoint import DirectoryCheckpointCallback, resume
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD

SMALL = {"features_extractor_kwargs": {"channels": [4, 8, 8]}, "net_arch": [16]}
BOX = spaces.Box(0.0, 1.0, (1, 16, 16))


def make_model(env: Any, algorithm: type[SACfD] = SACfD, **kwargs: Any) -> SACfD:
    kwargs = {"expert_episodes": 5, "batch_size": 8, "buffer_size": 300, "policy_kwargs": SMALL, **kwargs}
    return algorithm("MultiInputPolicy", env, seed=0, device="cpu", **kwargs)


def assert_equal_parameters(first: Any, second: Any) -> None:
    theirs = second.policy.state_dict()
    for name, value in first.policy.state_dict().items():
        np.testing.assert_array_equal(value.numpy(), theirs[name].numpy(), err_msg=name)


class Watch(BaseCallback):
    """Record the state of the training at the start of every rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[int, int, int]] = []

    def _on_rollout_start(self) -> None:
        assert self.model.replay_buffer.expert_size > 0
        self.seen.append((self.model.num_timesteps, self.model._n_updates, self.model.pretraining_left))

    def _on_step(self) -> bool:
        return True


def test_callbacks_are_called_in_the_pretraining(make_toy: Any) -> None:
    watch = Watch()
    make_model(make_toy(), pretrain_steps=3).learn(2, callback=watch)
    assert watch.seen == [(0, 0, 3), (0, 1, 2), (0, 2, 1), (0, 3, 0), (1, 4, 0)]


def test_pretraining_is_logged_before_time_step_0(make_toy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_extensions.demonstrations.off_policy.PRETRAINING_LOG_INTERVAL", 2)
    model = make_model(make_toy(), pretrain_steps=5)
    model.learn(0)  # sets the logger
    dumped: list[tuple[int, bool]] = []
    dump = model.logger.dump

    def spy(step: int = 0) -> None:
        dumped.append((step, "train/bc_loss" in model.logger.name_to_value))
        dump(step)

    monkeypatch.setattr(model.logger, "dump", spy)
    monkeypatch.setattr(model, "_custom_logger", True)
    model.learn(1)
    assert dumped[:2] == [(-3, True), (-1, True)]


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    [
        (SACfD, {"pretrain_steps": 9, "critic_warmup_steps": 7}),
        (SACfD, {"pretrain_steps": 9}),
        (FERM, {"pretrain_steps": 4, "contrastive_steps": 5, "augmentation": {"rad": {"size": 12}}}),
        (FERM, {"pretrain_steps": 3, "contrastive_steps": 2, "augmentation": {"rad": {"size": 12}}}),
    ],
)
def test_run_interrupted_in_pretraining_resumes_there(
    algorithm: type[SACfD], kwargs: dict[str, Any], make_toy: Any, tmp_path: Path
) -> None:
    if algorithm is FERM:
        kwargs = {
            **kwargs,
            "policy_kwargs": {
                "features_extractor_kwargs": {"channels": [4, 8, 8], "features_dim": 6},
                "net_arch": [16],
            },
        }
    whole = make_model(make_toy(), algorithm, **kwargs).learn(12)

    class Kill(BaseCallback):
        def _on_rollout_start(self) -> None:
            if self.model.n_pretrained == 4:
                raise KeyboardInterrupt

        def _on_step(self) -> bool:
            return True

    with pytest.raises(KeyboardInterrupt):
        saving = DirectoryCheckpointCallback(3, tmp_path)
        make_model(make_toy(), algorithm, **kwargs).learn(12, callback=[saving, Kill()])
    [checkpoint] = tmp_path.iterdir()
    resumed = resume(checkpoint, make_toy(seed=5), device="cpu")
    assert isinstance(resumed, algorithm)
    assert (resumed.num_timesteps, resumed.n_pretrained) == (0, 3)
    resumed.learn(12, reset_num_timesteps=False)
    assert resumed._n_updates == whole._n_updates
    assert_equal_parameters(whole, resumed)


def test_pretraining_is_done_once(make_toy: Any, tmp_path: Path) -> None:
    model = make_model(make_toy(), pretrain_steps=3, critic_warmup_steps=2).learn(2)
    assert model.n_pretrained == 3
    model.save(tmp_path / "model")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu")
    loaded.learn(2)
    assert loaded.n_pretrained == 3
    assert loaded.replay_buffer is not None and loaded.replay_buffer.expert_size > 0


def test_the_replay_buffer_follows_the_discount(make_toy: Any, tmp_path: Path) -> None:
    model = make_model(make_toy(), gamma=0.9, n_steps=3).learn(30)
    buffer = model.replay_buffer
    assert buffer is not None and (buffer.gamma, buffer.n_steps, model.n_steps) == (0.9, 3, 3)
    model.gamma, model.n_steps = 0.5, 2
    model.learn(1, reset_num_timesteps=False)
    assert (buffer.gamma, buffer.n_steps) == (0.5, 2)
    model.save(tmp_path / "model")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu", gamma=0.7, replay_buffer_kwargs={})
    assert loaded.replay_buffer is not None and loaded.replay_buffer.gamma == 0.7
    assert loaded.replay_buffer.n_steps == loaded.n_steps == 2
    loaded.learn(3)


@pytest.mark.parametrize("quantise", ["uint8", "uint16"])
def test_the_buffer_stores_what_the_extractor_rounds_to(quantise: str, make_toy: Any) -> None:
    policy_kwargs = {"features_extractor_kwargs": {"channels": [4, 8, 8], "quantise": quantise}}
    model = make_model(make_toy(), policy_kwargs=policy_kwargs)
    assert model.replay_buffer is not None
    assert model.replay_buffer.image_dtype == quantise


@pytest.mark.parametrize(("stored", "quantise"), [("uint16", "uint8"), ("uint8", "uint16"), ("uint8", None)])
def test_different_rounding_of_buffer_and_policy_is_rejected(
    stored: str, quantise: str | None, make_toy: Any
) -> None:
    extractor = {"channels": [4, 8, 8], "quantise": quantise}
    with pytest.raises(ValueError, match=f"image_dtype='{stored}'.*quantise={quantise!r}"):
        make_model(
            make_toy(),
            replay_buffer_kwargs={"image_dtype": stored},
            policy_kwargs={"features_extractor_kwargs": extractor},
        )


@pytest.mark.parametrize("name", ["gamma", "n_steps"])
def test_discount_in_replay_buffer_kwargs_is_rejected(name: str, make_toy: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} must be an argument of the algorithm"):
        make_model(make_toy(), replay_buffer_kwargs={name: 0.9})


def test_interrupted_collection_starts_again(make_toy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = make_model(make_toy()).learn(3)
    model = make_model(make_toy())
    add, added = model.replay_buffer.add_episode, []

    def interrupted(*args: Any, **kwargs: Any) -> None:
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


def test_loaded_model_requires_expert_data_again(make_toy: Any, tmp_path: Path) -> None:
    data = list(collect_episodes(make_expert_envs(make_toy())[0][0], 2, seed=0))
    model = make_model(make_toy(), expert_data=data).learn(2)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu")
    with pytest.raises(ValueError, match=r"expert_data must be set after load\(\), got None"):
        loaded.learn(2)
    loaded.expert_data = data
    loaded.learn(2)
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.learn(2).replay_buffer.expert_size == model.replay_buffer.expert_size


@pytest.mark.parametrize(
    ("n_envs", "quantise", "message"),
    [(1, "uint16", "image_dtype='uint16'"), (2, "uint8", "n_envs of the buffer must be 1, got 2")],
)
def test_a_replay_buffer_of_another_kind_is_rejected(
    n_envs: int, quantise: str, message: str, make_toy: Any, tmp_path: Path
) -> None:
    extractor = {"channels": [4, 8, 8], "quantise": quantise}
    other = make_model(make_toy(n_envs), policy_kwargs={"features_extractor_kwargs": extractor})
    other.save_replay_buffer(tmp_path / "buffer")
    model = make_model(make_toy())
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=message):
        model.learn(1)


@pytest.mark.parametrize(
    ("name", "space"),
    [("observation_space", spaces.Dict({"rgb": BOX})), ("action_space", spaces.Box(-2.0, 2.0, (5,)))],
)
def test_a_replay_buffer_of_another_environment_is_rejected(
    name: str, space: spaces.Space[Any], make_toy: Any, tmp_path: Path
) -> None:
    other, model = make_model(make_toy()), make_model(make_toy())
    setattr(other.replay_buffer, name, space)
    other.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    message = f"{name} of the buffer must be {getattr(model, name)}, got {space}"
    with pytest.raises(ValueError, match=re.escape(message)):
        model.learn(1)


def test_a_replay_buffer_of_another_class_is_rejected(make_toy: Any, tmp_path: Path) -> None:
    stock = SAC("MultiInputPolicy", make_toy(), buffer_size=50, policy_kwargs={"net_arch": [4]})
    stock.save_replay_buffer(tmp_path / "buffer")
    model = make_model(make_toy())
    model.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(AssertionError, match="ExpertReplayBuffer"):
        model.learn(1)


def test_normalised_images_are_refused(make_toy: Any) -> None:
    with pytest.raises(ValueError, match=r"must not normalise the images \['heightmap'\]"):
        make_model(VecNormalize(make_toy())).learn(1)
    for kwargs in ({"norm_obs": False}, {"norm_obs_keys": ["holding"]}):
        make_model(VecNormalize(make_toy(), **kwargs)).learn(1)


def test_demonstrations_that_do_not_fit_are_refused(make_toy: Any) -> None:
    model = make_model(make_toy(), buffer_size=12)
    with pytest.raises(ValueError, match=r"buffer_size must be at least \d+ for the demonstrations, got 12"):
        model.learn(1)
    assert model.replay_buffer is not None and model.replay_buffer.size() == 0
