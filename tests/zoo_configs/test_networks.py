"""Networks of the presets as ``train`` builds them, before they have learned anything."""

import functools

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
import torch as th

from bulletarm_gym.benchmarks import BENCHMARKS
from measure_updates import make_model
from zoo_configs.cli import main
from zoo_configs.drawing.video import PANEL_SIZE
from zoo_configs.environments import register_environments
from zoo_configs.experiments.config import resolve

register_environments()
BLOCKS, STACKING = "BulletArm/CloseLoopBlockStacking-v0", "BulletArm/OpenLoopBlockStacking-v0"
RAMP = "BulletArm/OpenLoopRampBlockStacking-v0"
CLOSED_LOOP = ("sacfd", "rad_sac", "ferm_sacfd", "equi_sacfd_per_aug", "equi_tqc", "sacfd_state")
NETWORKS_3D = ("fcn", "equi_fcn", "rot_fcn", "cnn_asr", "equi_asr")
OPEN_LOOP = [
    *((network, STACKING, "open_loop_3d") for network in NETWORKS_3D),
    ("cnn_asr_6d", RAMP, "open_loop_6d"),
    ("equi_deictic_asr", "BulletArm/OpenLoopBumpHouseBuilding4-v0", "open_loop_6d"),
]
UNTRAINED = {"expert_episodes": 0, "pretrain_steps": 0, "buffer_size": 100}


@functools.cache
def real_observations(**env_kwargs):
    """Return the observations while blocks are stacked, (n, ...) each."""
    env = gym.make(BLOCKS, **env_kwargs)
    observations, over = [env.reset(seed=0)[0]], False
    while not over:
        observation, _, terminated, truncated, _ = env.step(env.unwrapped.expert_action())  # type: ignore[attr-defined]
        observations.append(observation)
        over = terminated or truncated
    env.close()
    return {key: th.as_tensor(np.stack([entry[key] for entry in observations])) for key in observations[0]}


@pytest.mark.parametrize("baseline", CLOSED_LOOP)
def test_an_untrained_agent_expects_nothing_and_explores(baseline):
    """Values lie in [0, 1]. In the preset "cpu"; networks of the preset "paper" are not normalised."""
    model = make_model(resolve(baseline, "cpu", BLOCKS), "cpu", **UNTRAINED)
    spaces, observation = model.observation_space.spaces, "state" if baseline.endswith("_state") else "image"
    size = {"obs_size": spaces["heightmap"].shape[-1]} if observation == "image" else {}
    observations = real_observations(observation=observation, **size)
    assert observations.keys() == spaces.keys()
    model.env.close()
    actions = th.rand(len(observations["holding"]), 5, generator=th.Generator().manual_seed(0)) * 2 - 1
    with th.no_grad():
        mean, log_std, _ = model.actor.get_action_dist_params(observations)
        values = th.stack(tuple(model.critic(observations, actions)))
    assert values.isfinite().all() and values.abs().max() <= 1
    assert mean.tanh().abs().max() <= 0.3
    assert 0.5 <= log_std.exp().min() and log_std.exp().max() <= 2
    first = {key: value[0].numpy() for key, value in observations.items()}
    assert model.predict(first, deterministic=True)[0].shape == model.action_space.shape


@pytest.mark.parametrize("preset", ["cpu", pytest.param("paper", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("network", "env_id", "benchmark"), OPEN_LOOP)
def test_an_untrained_spatial_network_expects_nothing(network, env_id, benchmark, preset):
    """Networks of the paper, which need a GPU, are built but not evaluated."""
    experiment = resolve(f"sdqfd_{network}", preset, env_id, benchmark=benchmark)
    model = make_model(experiment, "cpu", **UNTRAINED)
    assert model.policy.action_sequence == BENCHMARKS[benchmark].action_sequence
    if preset == "cpu":
        observations, _ = model.policy.obs_to_tensor(model.env.reset())
        indices, _ = model.q_net.greedy(observations)
        with th.no_grad():
            values = model.q_net.values(observations, indices)
        assert all(level.isfinite().all() and level.abs().max() <= 1 for level in values)
    model.env.close()


def test_a_video_shows_the_values_of_a_spatial_policy(tmp_path):
    model = make_model(resolve("sdqfd_fcn", "cpu", STACKING), "cpu", **UNTRAINED)
    model.save(tmp_path / "model")
    model.env.close()
    words = [str(tmp_path / "model.zip"), "--env", STACKING, "--env-kwargs", "obs_size:64", "in_hand_size:16"]
    video = tmp_path / "video.gif"
    assert main(["record", *words, "max_steps:1", "-n", "1", "-o", str(video), "--device", "cpu"]) == 0
    frames = iio.imread(video)
    assert frames.shape[2] == 4 * PANEL_SIZE  # scene, heightmap, in-hand image, values
    assert len(np.unique(frames[0][:PANEL_SIZE, -PANEL_SIZE:].reshape(-1, 3), axis=0)) > 2
