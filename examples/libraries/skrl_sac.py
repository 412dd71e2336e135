"""skrl: SAC with the heightmap and the number, without a wrapper."""

from typing import Any

import gymnasium
import torch
from skrl.agents.torch.sac import SAC, SAC_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.spaces.torch import unflatten_tensorized_space
from torch import nn

ENV_ID = "bulletarm_gym:BulletArm/CloseLoopBlockReaching-v0"


class Encoder(nn.Module):
    """A flat observation, and for the critic an action, to numbers."""

    def __init__(self, space: gymnasium.Space[Any], outputs: int) -> None:
        super().__init__()
        self.space = space
        self.image = nn.Sequential(
            nn.LazyConv2d(32, 8, 4), nn.ReLU(), nn.LazyConv2d(64, 4, 2), nn.ReLU(), nn.Flatten()
        )
        self.head = nn.Sequential(nn.LazyLinear(256), nn.ReLU(), nn.Linear(256, outputs))

    def forward(self, flat: torch.Tensor, *action: torch.Tensor) -> torch.Tensor:
        """Return (batch, outputs)."""
        observation = unflatten_tensorized_space(self.space, flat)
        image = self.image(observation["heightmap"] / 0.4)
        return self.head(torch.cat([image, observation["holding"], *action], dim=1))


class Actor(GaussianMixin, Model):
    """Normal distribution of actions."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self, clip_actions=True)
        self.encoder = Encoder(self.observation_space, self.num_actions)
        self.log_std = nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs: dict[str, torch.Tensor], role: str) -> Any:
        """Return the mean and the logarithm of the standard deviation."""
        return torch.tanh(self.encoder(inputs["observations"])), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """The value of an action."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.encoder = Encoder(self.observation_space, 1)

    def compute(self, inputs: dict[str, torch.Tensor], role: str) -> Any:
        """Return (batch, 1)."""
        return self.encoder(inputs["observations"], inputs["taken_actions"]), {}


if __name__ == "__main__":
    set_seed(0)
    env = wrap_env(gymnasium.make(ENV_ID, obs_size=64))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    spaces["device"] = env.device
    names = ("critic_1", "critic_2", "target_critic_1", "target_critic_2")
    models = {"policy": Actor(**spaces)} | {name: Critic(**spaces) for name in names}
    observation, _ = env.reset()
    action = torch.zeros(1, env.action_space.shape[0], device=env.device)
    for model in models.values():  # gives lazy layers their sizes
        model.act({"observations": observation, "taken_actions": action}, role="")
    memory = RandomMemory(memory_size=1_000, device=env.device)
    cfg = SAC_CFG(batch_size=32, learning_starts=32, random_timesteps=32)
    agent = SAC(models=models, memory=memory, cfg=cfg, **spaces)
    SequentialTrainer(cfg={"timesteps": 40, "headless": True}, env=env, agents=agent).train()
    print(len(memory), "transitions")
