"""TorchRL: SAC on two environments in processes of their own."""

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymWrapper, ParallelEnv
from torchrl.modules import ConvNet, NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "bulletarm_gym:BulletArm/CloseLoopBlockReaching-v0"


def make_env() -> GymWrapper:
    """Make one environment."""
    return GymWrapper(ImageObservation(gymnasium.make(ENV_ID, obs_size=64)))


class Encoder(nn.Module):
    """An image of bytes, and for the critic an action, to numbers."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.images = ConvNet(num_cells=[32, 64, 64], kernel_sizes=[8, 4, 3], strides=[4, 2, 1])
        self.head = nn.Sequential(nn.LazyLinear(256), nn.ReLU(), nn.Linear(256, outputs))

    def forward(self, image: torch.Tensor, *action: torch.Tensor) -> torch.Tensor:
        """Return (..., outputs)."""
        return self.head(torch.cat([self.images(image / 255.0), *action], dim=-1))


if __name__ == "__main__":
    torch.manual_seed(0)
    env = ParallelEnv(2, make_env)
    size = env.action_spec.shape[-1]
    parameters = nn.Sequential(Encoder(2 * size), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(parameters, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
        spec=env.action_spec_unbatched,
    )
    critic = TensorDictModule(Encoder(1), in_keys=["observation", "action"], out_keys=["state_action_value"])
    critic(actor(env.reset()))  # gives lazy layers their sizes
    loss = SACLoss(actor, critic, action_spec=env.action_spec_unbatched)
    loss.make_value_estimator(gamma=0.99)
    targets, optimizer = SoftUpdate(loss, eps=0.995), torch.optim.Adam(loss.parameters(), 3e-4)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=64)
    collector = Collector(env, actor, frames_per_batch=32, total_frames=128, init_random_frames=64)
    for data in collector:
        buffer.extend(data.reshape(-1))
        losses = loss(buffer.sample())
        optimizer.zero_grad()
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        optimizer.step()
        targets.step()
        print(f"{len(buffer)} transitions, critic's loss {losses['loss_qvalue'].item():.3f}")
    collector.shutdown()
