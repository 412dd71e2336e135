"""TorchRL: a replay buffer with the episodes of a Minari dataset."""

import minari
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from bulletarm_gym import demonstrations

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"


def transitions(episode: minari.EpisodeData) -> TensorDict:
    """Return the transitions of an episode, named as TorchRL names them."""
    observations = {name: torch.as_tensor(values) for name, values in episode.observations.items()}
    following = {name: values[1:] for name, values in observations.items()}
    following["reward"] = torch.as_tensor(episode.rewards).float()[:, None]
    following["terminated"] = torch.as_tensor(episode.terminations)[:, None]
    following["truncated"] = torch.as_tensor(episode.truncations)[:, None]
    following["done"] = following["terminated"] | following["truncated"]
    steps = {name: values[:-1] for name, values in observations.items()}
    steps.update(action=torch.as_tensor(episode.actions), next=following)
    return TensorDict(steps, batch_size=len(episode.actions))


expert = demonstrations.collect(ENV_ID, 3, seed=0, env_kwargs={"obs_size": 64})
demonstrations.export_minari(expert, "bulletarm/block-reaching/torchrl-v0")
dataset = minari.load_dataset("bulletarm/block-reaching/torchrl-v0")
data = torch.cat([transitions(episode) for episode in dataset])
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=32)
buffer.extend(data)
print(len(buffer), "transitions, rewards", buffer[:]["next", "reward"].flatten().tolist())
print("batch", tuple(buffer.sample()["heightmap"].shape))
