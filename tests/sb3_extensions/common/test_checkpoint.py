"""Checkpoints are written atomically, and a resumed run equals an uninterrupted one."""

import errno
import json
import shutil
import zlib

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.wrappers import (
    DelayObservation,
    FrameStackObservation,
    NormalizeReward,
    TimeAwareObservation,
    TransformObservation,
    TransformReward,
)
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from torch.utils._pytree import tree_leaves

from bulletarm_gym.wrappers import InstructionInfo, ResetOptions
from sb3_extensions.common.checkpoint import (
    CheckpointError,
    DirectoryCheckpointCallback,
    latest_checkpoint,
    resume,
    save_checkpoint,
)
from sb3_extensions.ferm import FERM
from sb3_extensions.tqcfd import TQCfD

STEPS, MORE_STEPS = 14, 16  # the first ends in the middle of episodes


@pytest.fixture
def make_model(make_learner):
    """Makes a learner with a small buffer and a schedule: ``make_model(env, learner, **kwargs)``."""

    def make(*args, **kwargs):
        settings = {"expert_episodes": 4, "batch_size": 8, "buffer_size": 60}
        settings["learning_rate"] = lambda remaining: 1e-3 * remaining
        return make_learner(*args, **{**settings, **kwargs})

    return make


def assert_same(first, second):
    """Assert that two models have equal parameters, counters, statistics and samples."""
    assert_equal_trees(first.get_parameters(), second.get_parameters())
    assert_equal_trees(first._last_obs, second._last_obs)
    for name in ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining"):
        assert getattr(first, name) == getattr(second, name), name
    episodes = [[(e["r"], e["l"]) for e in m.ep_info_buffer] for m in (first, second)]
    assert episodes[0] == episodes[1] and first.ep_success_buffer == second.ep_success_buffer
    statistics = [model.get_vec_normalize_env() for model in (first, second)]
    if statistics[0] is not None:
        assert_equal_trees(*([vars(each.ret_rms), vars(each.obs_rms["holding"])] for each in statistics))


def assert_equal_trees(first, second):
    for ours, theirs in zip(tree_leaves(first), tree_leaves(second), strict=True):
        np.testing.assert_array_equal(ours, theirs)


SHARES = {"replay_buffer_kwargs": {"sampler": {"shares": {"expert_fraction": 0.3}}}}


@pytest.mark.parametrize(
    ("n_envs", "kwargs"),
    [
        (2, {"action_noise": NormalActionNoise(np.zeros(5), np.full(5, 0.1)), "learning_starts": 20}),
        (2, {"replay_buffer_kwargs": {"sampler": "prioritized"}, "augmentation": "rotation", "n_steps": 2}),
        (1, {"learner": TQCfD, "policy": "EquivariantPolicy", "augmentation": "drq", **SHARES}),
        (2, {"learner": FERM, "augmentation": {"rotation": {}, "rad": {"size": 12}}}),
    ],
)
def test_resumed_run_equals_uninterrupted_run(n_envs, kwargs, make_toy, make_model, tmp_path):
    whole = make_model(make_toy(n_envs), **kwargs).learn(STEPS + MORE_STEPS)
    saving = DirectoryCheckpointCallback(STEPS, tmp_path)
    watched = make_model(make_toy(n_envs), **kwargs).learn(STEPS + MORE_STEPS, callback=saving)
    assert_same(whole, watched)  # taking checkpoints changes nothing

    env = make_toy(n_envs, seed=123)
    env.reset()
    env.step(np.ones((n_envs, 5)))  # the previous state of the environment has no effect
    np.random.seed(9)
    resumed = resume(min(tmp_path.iterdir()), env, device="cpu")
    assert env.get_attr("steps") != [0] * n_envs  # mid-episode
    resumed.learn(STEPS + MORE_STEPS - resumed.num_timesteps, reset_num_timesteps=False)
    assert_same(whole, resumed)
    samples = [model.replay_buffer.sample(50)._asdict() for model in (whole, resumed)]
    assert_equal_trees(*samples)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"pretrain_steps": 9, "critic_warmup_steps": 7},
        {"learner": FERM, "pretrain_steps": 3, "contrastive_steps": 2},
    ],
)
def test_run_interrupted_in_pretraining_resumes_there(kwargs, make_toy, make_model, tmp_path):
    whole = make_model(**kwargs).learn(12)

    class Kill(BaseCallback):
        def _on_rollout_start(self):
            if self.model.n_pretrained == 4:
                raise KeyboardInterrupt

        def _on_step(self):
            return True

    with pytest.raises(KeyboardInterrupt):
        make_model(**kwargs).learn(12, callback=[DirectoryCheckpointCallback(3, tmp_path), Kill()])
    [checkpoint] = tmp_path.iterdir()
    resumed = resume(checkpoint, make_toy(seed=5), device="cpu")
    assert (resumed.num_timesteps, resumed.n_pretrained) == (0, 3)
    resumed.learn(12, reset_num_timesteps=False)
    assert resumed._n_updates == whole._n_updates
    assert_equal_trees(whole.get_parameters(), resumed.get_parameters())


def stacked(env):
    parts = {key: spaces.Box(0, 1, (2, *part.shape[1:])) for key, part in env.observation_space.items()}
    env = FrameStackObservation(env, 2)
    return TransformObservation(env, lambda obs: {k: v[:, 0] for k, v in obs.items()}, spaces.Dict(parts))


def normalised(env):
    return VecNormalize(VecMonitor(env), norm_obs_keys=["holding"])


def stock_algorithm(env):
    settings = {"n_steps": 8, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    return PPO("MultiInputPolicy", env, seed=0, device="cpu", **settings)


def recurrent_algorithm(env):
    settings = {"n_steps": 4, "batch_size": 4, "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4}}
    return RecurrentPPO("MultiInputLstmPolicy", env, seed=0, device="cpu", **settings)


@pytest.mark.parametrize(
    ("wrap", "wrap_vector", "make"),
    [
        (lambda env: DelayObservation(env, 2), None, None),
        (lambda env: TimeAwareObservation(env, flatten=False), None, None),
        (lambda env: NormalizeReward(TransformReward(env, lambda reward: reward - 0.1)), None, None),
        (stacked, None, None),
        (None, normalised, None),
        (None, None, stock_algorithm),
        (None, None, recurrent_algorithm),
    ],
    ids=["delay", "time", "rewards", "frames", "vector", "stock algorithm", "recurrent algorithm"],
)
def test_wrappers_and_stock_algorithms_resume_exactly(wrap, wrap_vector, make, make_model, tmp_path):
    def make_env():
        limited = gym.make("ToyReach-v0", max_episode_steps=6)
        env = DummyVecEnv([lambda: wrap(limited) if wrap else limited])
        return wrap_vector(env) if wrap_vector else env

    saving = DirectoryCheckpointCallback(STEPS, tmp_path)
    whole = (make or make_model)(make_env()).learn(STEPS + MORE_STEPS, callback=saving)
    resumed = resume(min(tmp_path.iterdir()), make_env(), device="cpu")
    assert resumed.env.get_attr("steps") == resumed.env.get_attr("_elapsed_steps") != [0]
    resumed.learn(STEPS + MORE_STEPS - resumed.num_timesteps, reset_num_timesteps=False)
    assert_same(whole, resumed)


def test_options_of_resets_and_instructions_resume(tmp_path):
    def make_env():
        parameters = {"observation": "state", "object_scale_range": [0.6, 1.0]}
        core = gym.make("BulletArm/CloseLoopBlockReaching-v0", **parameters)
        return InstructionInfo(ResetOptions(core))

    whole = stock_algorithm(make_env()).learn(8)
    whole.env.env_method("set_reset_options", {"object_scale_range": 0.8})
    save_checkpoint(whole, tmp_path)
    episodes = []
    for env in (whole.env, resume(tmp_path, make_env(), device="cpu").env):
        resets = [(env.reset(), env.reset_infos[0]["instruction"]) for _ in range(5)]
        narrowed = dict(env.env_method("get_state")[0].narrowed)
        episodes.append(([sentence for _, sentence in resets], narrowed, resets[-1][0]["state"].tolist()))
    assert episodes[0] == episodes[1] and narrowed == {"object_scale_range": [0.8, 0.8]}


def test_latest_checkpoints_are_kept_in_the_order_of_writing(make_toy, make_model, tmp_path):
    model = make_model(pretrain_steps=30)
    model.learn(1, callback=DirectoryCheckpointCallback(10, tmp_path))
    newest = resume(tmp_path, make_toy(), device="cpu")
    assert (newest.n_pretrained, newest.num_timesteps) == (30, 0)
    model.learn(40, callback=DirectoryCheckpointCallback(10, tmp_path, keep=2))
    names = sorted(entry.name for entry in tmp_path.iterdir())
    assert names == ["checkpoint_000000000020_004", "checkpoint_000000000030_005"]
    model.learn(20, callback=DirectoryCheckpointCallback(10, tmp_path))  # counts timesteps from 0
    assert resume(tmp_path, make_toy(), device="cpu").num_timesteps == 10
    first, second = save_checkpoint(model, tmp_path), save_checkpoint(model, tmp_path)
    assert first != second == latest_checkpoint(tmp_path) and first.exists()  # at the same step
    for bad, named in (({"save_freq": 0}, "save_freq"), ({"save_freq": 1, "keep": 0}, "keep")):
        with pytest.raises(ValueError, match=named):
            DirectoryCheckpointCallback(path=tmp_path, **bad)
    with pytest.raises(ValueError, match="keep"):
        save_checkpoint(model, tmp_path, keep=0)


def test_interrupted_write_keeps_the_last_checkpoint(make_toy, make_model, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    model = make_model().learn(5)
    first = save_checkpoint(model, tmp_path, keep=1)
    model.learn(5, reset_num_timesteps=False)
    for target in ([model, "save"], [model, "save_replay_buffer"], ["os.rename"]):
        with monkeypatch.context() as patch:
            patch.setattr(*target, fail)
            with pytest.raises(OSError, match="space") as failed:
                save_checkpoint(model, tmp_path, keep=1)
        assert failed.value.filename.startswith(str(tmp_path))
        assert latest_checkpoint(tmp_path) == first
    assert resume(tmp_path, make_toy(), device="cpu").num_timesteps == 5
    second = save_checkpoint(model, tmp_path, keep=1)
    assert list(tmp_path.iterdir()) == [second]  # nothing half written is left behind


def test_resume_rejects_damaged_and_other_directories(make_toy, make_model, tmp_path):
    checkpoint, env = save_checkpoint(make_model().learn(5), tmp_path), make_toy()
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    other = (checkpoint / "state.pkl").read_bytes().replace(b"sb3_extensions.sacfd", b"sb3_extensions.other")
    checksums = {**manifest["crc32"], "state.pkl": zlib.crc32(other)}
    damages = {
        "damaged: model.zip": {"model.zip": b""},
        "damaged: replay_buffer.pkl": {"replay_buffer.pkl": b"0"},
        "model.zip is missing": {"model.zip": None},
        "state.pkl is missing": {"state.pkl": None},
        "format 99": {"manifest.json": json.dumps({**manifest, "format": 99}).encode()},
        r"sb3_extensions\.other": {
            "state.pkl": other,
            "manifest.json": json.dumps({**manifest, "crc32": checksums}).encode(),
        },
        "manifest": {"manifest.json": b"[]"},
        "copy": {"manifest.json": None},
    }
    for message, contents in damages.items():
        copy = shutil.copytree(checkpoint, tmp_path / "copy")
        for name, data in contents.items():
            (copy / name).unlink() if data is None else (copy / name).write_bytes(data)
        with pytest.raises(CheckpointError, match=message):
            resume(copy, env)
        shutil.rmtree(copy)
    with pytest.raises(CheckpointError, match="nowhere"):
        resume(tmp_path / "nowhere", env)
    with pytest.raises(ValueError, match="1 environments, got 2"):
        resume(checkpoint, make_toy(2))
    with pytest.raises(ValueError, match=r"got \['VecMonitor'\]"):
        resume(checkpoint, VecMonitor(env))


def test_envs_without_state_start_a_new_episode(monkeypatch, tmp_path):
    """Also those with get_state() alone."""
    monkeypatch.setattr(PendulumEnv, "get_state", lambda self: self.state, raising=False)

    def make_env():
        return VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))

    kwargs = {"buffer_size": 100, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    model = SAC("MlpPolicy", make_env(), learning_starts=5, device="cpu", **kwargs)
    save_checkpoint(model.learn(10), tmp_path)
    with pytest.warns(UserWarning, match="new episodes"):
        resumed = resume(tmp_path, make_env(), device="cpu")
    assert resumed._last_obs is None
    normalised, before = resumed.get_env(), model.get_env()
    assert normalised.obs_rms.count == before.obs_rms.count > 10
    assert normalised.ret_rms.var == before.ret_rms.var
    assert resumed.learn(5, reset_num_timesteps=False).num_timesteps == 15
