"""Minari: demonstrations exported, loaded and recorded."""

import gymnasium
import minari

from bulletarm_gym import demonstrations

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"

expert = demonstrations.collect(ENV_ID, 3, seed=0, env_kwargs={"obs_size": 64})
demonstrations.export_minari(expert, "bulletarm/block-reaching/expert-v0")
dataset = minari.load_dataset("bulletarm/block-reaching/expert-v0")
episode = dataset[0]
print(dataset.storage.metadata["task"])
print(dataset.total_episodes, "episodes,", episode.observations["heightmap"].shape, episode.actions.shape)
metadata = dataset.storage.get_episode_metadata(dataset.episode_indices)
print("seeds", [int(episode["seed"]) for episode in metadata])

env = minari.DataCollector(gymnasium.make(ENV_ID, obs_size=64))
env.reset(seed=0)
done = False
while not done:
    _, _, terminated, truncated, _ = env.step(env.unwrapped.expert_action())
    done = terminated or truncated
print(env.create_dataset("bulletarm/block-reaching/own-v0").total_steps, "steps recorded")
