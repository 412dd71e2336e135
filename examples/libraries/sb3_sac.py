"""Stable-Baselines3: SAC with its own CnnPolicy."""

import gymnasium
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

from bulletarm_gym.wrappers import ImageObservation

env = ImageObservation(gymnasium.make("BulletArm/CloseLoopBlockReaching-v0", obs_size=64))
model = SAC("CnnPolicy", env, buffer_size=10_000, batch_size=64, seed=0)
model.learn(110)
print("mean reward", evaluate_policy(model, model.get_env(), n_eval_episodes=5)[0])
