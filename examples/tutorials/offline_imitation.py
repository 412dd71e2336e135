"""Tutorial 6: collect demonstrations and imitate them with PyTorch alone."""

import sys

import gymnasium
import numpy as np
import torch
from torch import nn

from bulletarm_gym.demonstrations import collect, load
from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
EPISODES = int(sys.argv[1]) if len(sys.argv) > 1 else 200
UPDATES = 10 * EPISODES

collect(ENV_ID, EPISODES, seed=0, env_kwargs={"obs_size": 64}, path="reaching.h5")

# A uint8 image of each observation except the last of an episode, and the action of the expert.
env = ImageObservation(gymnasium.make(ENV_ID, obs_size=64))
episodes = list(load("reaching.h5"))
images = torch.as_tensor(np.concatenate([env.images(episode.observations)[:-1] for episode in episodes]))
actions = torch.as_tensor(np.concatenate([episode.actions for episode in episodes]))
print(f"{len(episodes)} episodes, {len(images)} steps")

torch.manual_seed(0)
policy = nn.Sequential(
    nn.Conv2d(2, 16, 5, 2), nn.ReLU(), nn.Conv2d(16, 32, 3, 2), nn.ReLU(), nn.Conv2d(32, 64, 3, 2), nn.ReLU(),
    nn.Flatten(), nn.LazyLinear(128), nn.ReLU(), nn.Linear(128, 5), nn.Tanh(),
)  # fmt: skip
policy(images[:1].float())  # sets the size of the lazy layer
optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
for _ in range(UPDATES):
    rows = torch.randint(len(images), (64,))
    loss = (policy(images[rows] / 255.0) - actions[rows]).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
print(f"error of the last update {loss.item():.4f}")

successes, tests = 0, min(20, EPISODES)
for seed in range(1_000, 1_000 + tests):
    image, _ = env.reset(seed=seed)
    over = False
    while not over:
        with torch.no_grad():
            action = policy(torch.as_tensor(image)[None] / 255.0)[0].numpy()
        image, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    successes += info["is_success"]
print(f"success rate {successes / tests:.2f} in {tests} episodes")
