"""imitation: behavioural cloning from demonstrations, as images."""

import gymnasium
import numpy as np
from imitation.algorithms.bc import BC
from imitation.data.rollout import flatten_trajectories
from imitation.data.types import Trajectory
from stable_baselines3.common.policies import ActorCriticCnnPolicy

from bulletarm_gym import demonstrations
from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"

expert = demonstrations.collect(ENV_ID, 10, seed=0, env_kwargs={"obs_size": 64})
env = ImageObservation(gymnasium.make(ENV_ID, obs_size=64))
trajectories = []
for episode in expert:
    images = env.images(episode.observations)
    trajectories.append(Trajectory(images, episode.actions, infos=None, terminal=True))
learner = BC(
    observation_space=env.observation_space,
    action_space=env.action_space,
    rng=np.random.default_rng(0),
    policy=ActorCriticCnnPolicy(env.observation_space, env.action_space, lambda _: 3e-4),
    demonstrations=flatten_trajectories(trajectories),
    batch_size=16,
)
learner.train(n_epochs=2, progress_bar=False, log_interval=10_000)
print("action at the start", learner.policy.predict(env.reset(seed=0)[0], deterministic=True)[0].round(2))
