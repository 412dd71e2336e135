"""d3rlpy: offline learning (TD3+BC) from demonstrations, as images."""

import d3rlpy
import gymnasium
import numpy as np
from d3rlpy.dataset import MDPDataset

from bulletarm_gym import demonstrations
from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"

expert = demonstrations.collect(ENV_ID, 10, seed=0, env_kwargs={"obs_size": 64})
env = ImageObservation(gymnasium.make(ENV_ID, obs_size=64))
parts = []
for episode in expert:
    images = env.images(episode.observations)[:-1]
    parts.append((images, episode.actions, episode.rewards, episode.terminations))
observations, actions, rewards, terminals = map(np.concatenate, zip(*parts, strict=True))
dataset = MDPDataset(observations, actions, rewards, terminals)
agent = d3rlpy.algos.TD3PlusBCConfig(
    batch_size=32, observation_scaler=d3rlpy.preprocessing.PixelObservationScaler()
).create()
agent.fit(dataset, n_steps=50, n_steps_per_epoch=50, logger_adapter=d3rlpy.logging.NoopAdapterFactory())
print(
    dataset.size(),
    "episodes;",
    "mean return",
    d3rlpy.metrics.evaluate_qlearning_with_environment(agent, env, 3),
)
