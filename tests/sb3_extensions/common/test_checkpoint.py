"""Checkpoints are written atomically, and a resumed run equals an uninterrupted one."""

import errno
import json
import shutil
import zlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_extensions.common.checkpoint import (
    CheckpointError,
    DirectoryCheckpointCallback,
    latest_checkpoint,
    latest_valid_checkpoint,
    resume,
    save_checkpoint,
)
from sb3_extensions.sacfd import SACfD
from sb3_extensions.spatial_dqn import ADET, SDQfD
from sb3_extensions.tqcfd import TQCfD

STEPS, MORE_STEPS = 28, 30  # the first ends in the middle of episodes
SMALL = {"net_arch": [16], "features_extractor_kwargs": {"channels": [4, 8, 8]}}


def make_model(env: Any, algorithm: type[SACfD] = SACfD, **kwargs: Any) -> SACfD:
    return algorithm(
        "MultiInputPolicy",
        env,
        expert_episodes=4,
        batch_size=8,
        buffer_size=60,
        learning_rate=lambda remaining: 1e-3 * remaining,
        policy_kwargs=SMALL,
        device="cpu",
        seed=0,
        **kwargs,
    )


def assert_same(first: Any, second: Any) -> None:
    """Assert that two models have equal parameters, counters and statistics."""
    ours, theirs = first.get_parameters(), second.get_parameters()
    assert_equal_trees(ours, theirs)
    assert_equal_trees(first._last_obs, second._last_obs)
    for name in ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining"):
        assert getattr(first, name) == getattr(second, name), name
    episodes = [[(e["r"], e["l"]) for e in m.ep_info_buffer] for m in (first, second)]
    assert episodes[0] == episodes[1]
    assert list(first.ep_success_buffer) == list(second.ep_success_buffer)


def assert_equal_trees(first: Any, second: Any) -> None:
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal_trees(first[key], second[key])
    elif isinstance(first, (list, tuple)):
        for a, b in zip(first, second, strict=True):
            assert_equal_trees(a, b)
    elif isinstance(first, (np.ndarray, th.Tensor)):
        np.testing.assert_array_equal(np.asarray(first), np.asarray(second))
    else:
        assert first == second


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"learning_starts": 40},
        {"action_noise": NormalActionNoise(np.zeros(5), np.full(5, 0.1))},
        {
            "replay_buffer_kwargs": {"sampler": "prioritized"},
            "augmentation": "rotation",
            "n_steps": 2,
        },
        {"algorithm": TQCfD},
        {"augmentation": "drq"},
        {
            "replay_buffer_kwargs": {"sampler": {"shares": {"success_fraction": 0.2}}},
            "self_imitation_temperature": 0.1,
            "exploration": 0.2,
            "deterministic_fraction": 0.3,
        },
        {"augmentation": {"rad": {"size": 12}}},
    ],
)
def test_resumed_run_equals_uninterrupted_run(
    n_envs: int, kwargs: dict[str, Any], make_toy: Any, tmp_path: Path
) -> None:
    whole = make_model(make_toy(n_envs), **kwargs).learn(STEPS + MORE_STEPS)

    saving = DirectoryCheckpointCallback(STEPS, tmp_path)
    watched = make_model(make_toy(n_envs), **kwargs).learn(STEPS + MORE_STEPS, callback=saving)
    assert_same(whole, watched)  # taking checkpoints changes nothing

    checkpoint = tmp_path / f"checkpoint_{STEPS:012d}_000"
    env = make_toy(n_envs, seed=123)
    env.reset()
    env.step(np.ones((n_envs, 5)))  # the previous state of the environment has no effect
    np.random.seed(9)
    resumed = resume(checkpoint, env, device="cpu")
    assert env.get_attr("steps") != [0] * n_envs  # mid-episode
    resumed.learn(MORE_STEPS, reset_num_timesteps=False)
    assert_same(whole, resumed)
    ours, theirs = whole.replay_buffer.sample(50), resumed.replay_buffer.sample(50)
    assert_equal_trees(ours._asdict(), theirs._asdict())


@pytest.mark.parametrize(
    "kwargs",
    [
        {"exploration_initial_eps": 0.5, "exploration_final_eps": 0.2, "augmentation": "rigid_motion"},
        {"learning_starts": 10, "algorithm": ADET, "sequence": "pxyzrrr"},
        {"replay_buffer_kwargs": {"sampler": "prioritized"}, "n_steps": 2},
    ],
)
def test_resumed_spatial_run_equals_uninterrupted_run(
    kwargs: dict[str, Any], make_picking: Any, tmp_path: Path
) -> None:
    kwargs = {"algorithm": SDQfD, "sequence": "pxyr", **kwargs}
    algorithm, sequence = kwargs.pop("algorithm"), kwargs.pop("sequence")
    networks = {"channels": [4, 4], "in_hand_channels": [4, 4, 4], "hidden": 8}
    networks |= {"patch_channels": [4, 4, 4], "patch_hidden": [8]}
    policy_kwargs = {
        "action_sequence": sequence,
        "network_kwargs": networks,
        "codec_kwargs": {"num_rotations": 4, "num_heights": 3, "num_tilts": 3},
    }

    def make_env(seed: int) -> Any:
        return make_picking(2, seed, size=16, action_sequence=sequence)

    def learn(callback: Any = None) -> Any:
        settings = {"expert_episodes": 2, "batch_size": 4, "target_update_interval": 3, "buffer_size": 60}
        model = algorithm(
            "ASRPolicy", make_env(0), policy_kwargs=policy_kwargs, seed=0, device="cpu", **settings, **kwargs
        )
        return model.learn(26, callback=callback)

    whole, watched = learn(), learn(DirectoryCheckpointCallback(14, tmp_path))
    assert_same(whole, watched)
    env = make_env(123)
    resumed = resume(tmp_path / "checkpoint_000000000014_000", env, device="cpu")
    assert env.get_attr("steps") != [0, 0]  # mid-episode
    resumed.learn(12, reset_num_timesteps=False)
    assert_same(whole, resumed)
    assert whole.exploration_rate == resumed.exploration_rate
    ours, theirs = whole.replay_buffer.sample(50), resumed.replay_buffer.sample(50)
    assert_equal_trees(ours._asdict(), theirs._asdict())


def test_state_of_vector_wrappers_is_restored(make_toy: Any, tmp_path: Path) -> None:
    def make_env() -> Any:
        return VecNormalize(
            VecMonitor(DummyVecEnv([lambda: gym.make("ToyReach-v0")] * 2)), norm_obs_keys=["holding"]
        )

    whole = make_model(make_env()).learn(STEPS + MORE_STEPS)
    save_checkpoint(make_model(make_env()).learn(STEPS), tmp_path)
    resumed = resume(tmp_path, make_env(), device="cpu")
    # The learning rate depends on the length of the run, which the first part did not know.
    resumed.learn(MORE_STEPS, reset_num_timesteps=False)
    np.testing.assert_array_equal(whole.env.ret_rms.count, resumed.env.ret_rms.count)
    np.testing.assert_array_equal(whole.env.obs_rms["holding"].count, resumed.env.obs_rms["holding"].count)
    assert [e["l"] for e in resumed.ep_info_buffer]
    assert max(e["l"] for e in resumed.ep_info_buffer) <= 10


def test_time_limits_are_restored(tmp_path: Path) -> None:
    def make_env() -> Any:
        return DummyVecEnv([lambda: gym.make("ToyReach-v0", max_episode_steps=6)])

    save_checkpoint(make_model(make_env()).learn(3), tmp_path)
    resumed = resume(tmp_path, make_env(), device="cpu")
    steps = resumed.env.get_attr("steps")
    assert steps == resumed.env.get_attr("_elapsed_steps") != [0]


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_stock_algorithms(algorithm: Any, make_toy: Any, tmp_path: Path) -> None:
    kwargs: dict[str, Any] = (
        {"n_steps": 8, "batch_size": 8} if algorithm is PPO else {"learning_starts": 10, "buffer_size": 100}
    )
    policy_kwargs = {"net_arch": [8]}
    kwargs |= {"policy_kwargs": policy_kwargs, "seed": 0, "device": "cpu"}
    whole = algorithm("MultiInputPolicy", make_toy(), **kwargs)
    whole.learn(48, callback=DirectoryCheckpointCallback(24, tmp_path))
    first = sorted(tmp_path.iterdir())[0]
    resumed = resume(first, make_toy(), device="cpu")
    resumed.learn(48 - resumed.num_timesteps, reset_num_timesteps=False)
    assert_same(whole, resumed)


def test_callback_keeps_the_latest_checkpoints(make_toy: Any, tmp_path: Path) -> None:
    make_model(make_toy(2)).learn(50, callback=DirectoryCheckpointCallback(10, tmp_path / "new", keep=2))
    names = sorted(entry.name for entry in (tmp_path / "new").iterdir())
    assert names == ["checkpoint_000000000030_002", "checkpoint_000000000040_003"]
    assert latest_checkpoint(tmp_path / "new") == tmp_path / "new" / names[-1]
    for bad in ({"save_freq": 0}, {"save_freq": 1, "keep": 0}):
        with pytest.raises(ValueError, match="at least 1"):
            DirectoryCheckpointCallback(path=tmp_path, **bad)


def test_saving_twice_at_the_same_step(make_toy: Any, tmp_path: Path) -> None:
    model = make_model(make_toy()).learn(5)
    first, second = save_checkpoint(model, tmp_path), save_checkpoint(model, tmp_path)
    assert first != second and first.exists()
    assert latest_checkpoint(tmp_path) == second


def test_checkpoints_are_ordered_by_time_of_writing(make_toy: Any, tmp_path: Path) -> None:
    model = make_model(make_toy(), pretrain_steps=70)
    model.learn(1, callback=DirectoryCheckpointCallback(10, tmp_path))
    newest = resume(tmp_path, make_toy(), device="cpu")
    assert (newest.n_pretrained, newest.num_timesteps) == (70, 0)
    model.learn(40, callback=DirectoryCheckpointCallback(10, tmp_path))
    model.learn(20, callback=DirectoryCheckpointCallback(10, tmp_path))  # counts timesteps from 0
    assert resume(tmp_path, make_toy(), device="cpu").num_timesteps == 10


def test_damaged_checkpoint_is_deleted_before_a_newer_one(make_toy: Any, tmp_path: Path) -> None:
    model = make_model(make_toy()).learn(5)
    save_checkpoint(model, tmp_path)
    damaged = save_checkpoint(model.learn(10, reset_num_timesteps=False), tmp_path)
    (damaged / "model.zip").write_bytes(b"")
    with pytest.warns(UserWarning, match="damaged"):
        resumed = resume(tmp_path, make_toy(), device="cpu")
    newest = save_checkpoint(resumed.learn(5, reset_num_timesteps=False), tmp_path, keep=1)
    assert list(tmp_path.iterdir()) == [newest] and resumed.num_timesteps == 10


def test_interrupted_write_keeps_the_last_checkpoint(
    make_toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model(make_toy()).learn(5)
    first = save_checkpoint(model, tmp_path, keep=1)
    model.learn(5, reset_num_timesteps=False)
    for victim in ("save", "save_replay_buffer"):
        with monkeypatch.context() as patch:
            patch.setattr(model, victim, _killed)
            with pytest.raises(KeyboardInterrupt):
                save_checkpoint(model, tmp_path, keep=1)
        assert latest_checkpoint(tmp_path) == first
    with monkeypatch.context() as patch:
        patch.setattr("os.rename", _killed)
        with pytest.raises(KeyboardInterrupt):
            save_checkpoint(model, tmp_path, keep=1)
    assert latest_checkpoint(tmp_path) == first
    assert resume(tmp_path, make_toy(), device="cpu").num_timesteps == 5
    second = save_checkpoint(model, tmp_path, keep=1)
    assert list(tmp_path.iterdir()) == [second]  # nothing half written is left behind


def _killed(*args: Any, **kwargs: Any) -> None:
    raise KeyboardInterrupt


def test_resume_rejects_damaged_and_other_directories(make_toy: Any, tmp_path: Path) -> None:
    checkpoint = save_checkpoint(make_model(make_toy()).learn(5), tmp_path)
    env = make_toy()
    with pytest.raises(CheckpointError, match="must have a checkpoint, got none"):
        resume(tmp_path / "nowhere", env)
    (tmp_path / "foreign").mkdir()
    with pytest.raises(CheckpointError, match="must have a checkpoint, got none"):
        resume(tmp_path / "foreign", env)
    for name in ("model.zip", "replay_buffer.pkl", "state.pkl"):
        copy = shutil.copytree(checkpoint, tmp_path / "copy")
        data = (copy / name).read_bytes()
        (copy / name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        with pytest.raises(CheckpointError, match=f"damaged: {name}"):
            resume(copy, env)
        (copy / name).unlink()
        with pytest.raises(CheckpointError, match=f"{name} is missing"):
            resume(copy, env)
        shutil.rmtree(copy)
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    (checkpoint / "manifest.json").write_text(json.dumps({**manifest, "format": 99}))
    with pytest.raises(CheckpointError, match="format 99"):
        resume(checkpoint, env)
    state = (checkpoint / "state.pkl").read_bytes().replace(b"sb3_extensions.sacfd", b"sb3_extensions.other")
    (checkpoint / "state.pkl").write_bytes(state)
    manifest["crc32"]["state.pkl"] = zlib.crc32(state)
    (checkpoint / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match=r"cannot be read: No module named 'sb3_extensions\.other"):
        resume(checkpoint, env)
    (checkpoint / "manifest.json").write_text("[]")
    with pytest.raises(CheckpointError, match="manifest"):
        resume(checkpoint, env)


def test_resume_skips_a_damaged_checkpoint(make_toy: Any, tmp_path: Path) -> None:
    model = make_model(make_toy()).learn(5)
    first = save_checkpoint(model, tmp_path)
    newest = save_checkpoint(model.learn(5, reset_num_timesteps=False), tmp_path)
    assert latest_valid_checkpoint(tmp_path) == (newest, [])
    (newest / "model.zip").write_bytes(b"")
    checkpoint, [damage] = latest_valid_checkpoint(tmp_path)
    assert checkpoint == first and f"{newest} is damaged: model.zip" in str(damage)
    with pytest.warns(UserWarning, match=f"model.zip .* Resuming from {first}"):
        assert resume(tmp_path, make_toy(), device="cpu").num_timesteps == 5
    (first / "state.pkl").unlink()
    with pytest.raises(CheckpointError, match=f"{newest} is damaged"):
        latest_valid_checkpoint(tmp_path)


def test_full_disk_leaves_no_incomplete_checkpoint(
    make_toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    model = make_model(make_toy()).learn(5)
    monkeypatch.setattr(model, "save_replay_buffer", fill)
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(model, tmp_path)
    assert not list(tmp_path.iterdir())


def test_other_number_of_envs(make_toy: Any, tmp_path: Path) -> None:
    save_checkpoint(make_model(make_toy(2)).learn(4), tmp_path)
    with pytest.raises(ValueError, match="2 environments, got 1"):
        resume(tmp_path, make_toy(1))
    with pytest.raises(ValueError, match=r"wrapped in \[\], got \['VecMonitor'\]"):
        resume(tmp_path, VecMonitor(make_toy(2)))


def test_envs_without_state_start_a_new_episode(tmp_path: Path) -> None:
    def make_env(n_envs: int = 1) -> VecNormalize:
        env = gym.make("Pendulum-v1")
        assert not hasattr(env.unwrapped, "get_state")
        return VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")] * n_envs))

    kwargs: dict[str, Any] = {"buffer_size": 100, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    model = SAC("MlpPolicy", make_env(), learning_starts=5, device="cpu", **kwargs)
    model.learn(10)
    save_checkpoint(model, tmp_path)
    with pytest.warns(UserWarning, match="new episodes start"):
        resumed = resume(tmp_path, make_env(), device="cpu")
    assert resumed._last_obs is None
    normalised, before = resumed.get_env(), model.get_env()
    assert normalised.obs_rms.count == before.obs_rms.count > 10
    np.testing.assert_array_equal(normalised.ret_rms.var, before.ret_rms.var)
    resumed.learn(5, reset_num_timesteps=False)
    assert resumed.num_timesteps == 15
    with pytest.raises(ValueError, match="1 environments, got 2"):
        resume(tmp_path, make_env(2))
