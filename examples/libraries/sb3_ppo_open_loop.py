"""Stable-Baselines3: PPO on an open-loop task, four environments at once."""

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from bulletarm_gym.wrappers import ImageObservation

env = make_vec_env(
    "BulletArm/OpenLoopBlockStacking-v0",
    n_envs=4,
    seed=0,
    env_kwargs={"obs_size": 64},
    wrapper_class=ImageObservation,
)
model = PPO("CnnPolicy", env, n_steps=16, batch_size=32, n_epochs=2, seed=0)
model.learn(64)
print(model.num_timesteps, "steps of", env.observation_space)
