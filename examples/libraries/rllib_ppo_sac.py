"""RLlib: PPO and SAC on the new API stack."""

import gymnasium
import numpy as np
import ray
from gymnasium.wrappers import DtypeObservation, RescaleObservation
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.tune import register_env

ENV_ID = "bulletarm_gym:BulletArm/CloseLoopBlockReaching-v0"


def make_env(config: dict) -> gymnasium.Env:
    """Make one environment; RLlib takes images with their channels last, as numbers of 0 to 1."""
    from bulletarm_gym.wrappers import ImageObservation

    env = ImageObservation(gymnasium.make(ENV_ID, **config), channels_last=True)
    return RescaleObservation(DtypeObservation(env, np.float32), np.float32(0), np.float32(1))


register_env("bulletarm", make_env)
ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
model = DefaultModelConfig(conv_filters=[[32, 8, 4], [64, 4, 2], [64, 3, 1]], head_fcnet_hiddens=[64])
ppo = PPOConfig().training(train_batch_size_per_learner=128, minibatch_size=32, num_epochs=2)
sac = SACConfig().training(
    train_batch_size_per_learner=32,
    num_steps_sampled_before_learning_starts=80,
    replay_buffer_config={"type": "EpisodeReplayBuffer", "capacity": 10_000},
)
for config in (ppo, sac):
    config.environment("bulletarm", env_config={"obs_size": 64}).env_runners(num_env_runners=0)
    config.rl_module(model_config=model).debugging(seed=0)
    config.reporting(min_sample_timesteps_per_iteration=100, min_time_s_per_iteration=0)
    algorithm = config.build_algo()
    results = algorithm.train()
    print(type(algorithm).__name__, results["num_env_steps_sampled_lifetime"], "steps")
    algorithm.stop()
