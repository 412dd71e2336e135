"""Tianshou: SAC on four environments in processes of their own."""

from typing import Any

import gymnasium
import numpy as np
import torch
from tianshou.algorithm import SAC
from tianshou.algorithm.modelfree.sac import SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import SubprocVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import ModuleWithVectorOutput
from tianshou.utils.net.continuous import ContinuousActorProbabilistic
from torch import nn

from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "bulletarm_gym:BulletArm/CloseLoopBlockReaching-v0"
FEATURES = 256


def make_env() -> gymnasium.Env[np.ndarray, np.ndarray]:
    """Make one environment."""
    return ImageObservation(gymnasium.make(ENV_ID, obs_size=64))


class Encoder(ModuleWithVectorOutput):
    """An image of bytes to features."""

    def __init__(self, channels: int) -> None:
        super().__init__(FEATURES)
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(),
            nn.Conv2d(64, 64, 3, 1), nn.ReLU(), nn.Flatten(), nn.Linear(1024, FEATURES), nn.ReLU(),
        )  # fmt: skip

    def forward(
        self, obs: np.ndarray | torch.Tensor, state: Any = None, info: Any = None
    ) -> tuple[torch.Tensor, Any]:
        """Return the features and the state."""
        return self.layers(torch.as_tensor(obs).float() / 255.0), state


class Critic(nn.Module):
    """The value of an action."""

    def __init__(self, channels: int, actions: int) -> None:
        super().__init__()
        self.encoder, self.value = Encoder(channels), nn.Linear(FEATURES + actions, 1)

    def forward(
        self, obs: np.ndarray | torch.Tensor, act: np.ndarray | torch.Tensor, info: Any = None
    ) -> torch.Tensor:
        """Return (batch, 1)."""
        return self.value(torch.cat([self.encoder(obs)[0], torch.as_tensor(act)], dim=1))


if __name__ == "__main__":
    torch.manual_seed(0)
    envs = SubprocVectorEnv([make_env] * 4)
    env = make_env()
    channels, actions = env.observation_space.shape[0], env.action_space.shape[0]
    actor = ContinuousActorProbabilistic(
        preprocess_net=Encoder(channels), action_shape=actions, unbounded=True, conditioned_sigma=True
    )
    optimizer = AdamOptimizerFactory(lr=3e-4)
    algorithm = SAC(
        policy=SACPolicy(actor=actor, action_space=env.action_space),
        policy_optim=optimizer,
        critic=Critic(channels, actions),
        critic_optim=optimizer,
    )
    collector = Collector(algorithm, envs, VectorReplayBuffer(10_000, len(envs)))
    collector.reset(gym_reset_kwargs={"seed": 0})
    collector.collect(n_step=64, random=True)
    algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=collector,
            max_epochs=1,
            epoch_num_steps=64,
            collection_step_num_env_steps=32,
            update_step_num_gradient_steps_per_sample=0.25,
            batch_size=32,
            show_progress=False,
            verbose=False,
        )
    )
    print(len(collector.buffer), "transitions")
    envs.close()
