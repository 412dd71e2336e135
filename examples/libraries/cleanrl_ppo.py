"""PPO in one file, in the style of CleanRL: plain PyTorch and Gymnasium's wrappers."""

import gymnasium
import torch
from gymnasium.wrappers import ClipAction
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import nn
from torch.distributions import Normal

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.wrappers import ImageObservation

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
NUM_ENVS, NUM_STEPS, ITERATIONS, EPOCHS, BATCHES = 4, 64, 2, 2, 4
GAMMA, LAMBDA, CLIP, ENTROPY, RATE = 0.99, 0.95, 0.2, 0.001, 3e-4


class Agent(nn.Module):
    """Actor and critic on one convolutional encoder."""

    def __init__(self, channels: int, actions: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(
            nn.Conv2d(channels, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(),
            nn.Conv2d(64, 64, 3, 1), nn.ReLU(), nn.Flatten(), nn.LazyLinear(256), nn.ReLU(),
        )  # fmt: skip
        self.mean, self.value = nn.Linear(256, actions), nn.Linear(256, 1)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))

    def forward(self, image: torch.Tensor) -> tuple[Normal, torch.Tensor]:
        """Return the distribution of actions and the value."""
        features = self.encoder(image / 255.0)
        return Normal(self.mean(features), self.log_std.exp()), self.value(features)[:, 0]


torch.manual_seed(0)
envs = gymnasium.make_vec(
    ENV_ID,
    num_envs=NUM_ENVS,
    vectorization_mode="sync",
    wrappers=[ImageObservation, ClipAction],
    obs_size=64,
)
envs = RecordEpisodeStatistics(envs)
agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
image = torch.as_tensor(envs.reset(seed=0)[0])
agent(image)  # gives the lazy layer its size
optimizer = torch.optim.Adam(agent.parameters(), RATE)
done = torch.zeros(NUM_ENVS)
for iteration in range(ITERATIONS):
    steps = []
    for _ in range(NUM_STEPS):
        with torch.no_grad():
            policy, value = agent(image)
        action = policy.sample()
        following, reward, terminated, truncated, _ = envs.step(action.numpy())
        steps.append(
            (image, action, policy.log_prob(action).sum(1), value, torch.as_tensor(reward).float(), done)
        )
        image, done = torch.as_tensor(following), torch.as_tensor(terminated | truncated).float()
    images, actions, log_probs, values, rewards, dones = map(torch.stack, zip(*steps, strict=True))
    with torch.no_grad():
        later_value, later_done, advantage = agent(image)[1], done, torch.zeros(NUM_ENVS)
    advantages = torch.zeros_like(rewards)
    for t in reversed(range(NUM_STEPS)):
        delta = rewards[t] + GAMMA * later_value * (1 - later_done) - values[t]
        advantages[t] = advantage = delta + GAMMA * LAMBDA * (1 - later_done) * advantage
        later_value, later_done = values[t], dones[t]
    # The step after an episode's last one only resets: Gymnasium's autoreset in the next step.
    played = (1 - dones).bool().flatten()
    data = [
        part.flatten(0, 1)[played] for part in (images, actions, log_probs, advantages, advantages + values)
    ]
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(data[0])).chunk(BATCHES):
            observed, chosen, old_log_prob, gain, target = (part[rows] for part in data)
            policy, value = agent(observed)
            ratio = (policy.log_prob(chosen).sum(1) - old_log_prob).exp()
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            surrogate = torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            loss = (value - target).square().mean() / 2 - surrogate - ENTROPY * policy.entropy().sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()
    returns = list(envs.return_queue)
    mean = sum(returns) / max(1, len(returns))
    print(f"iteration {iteration}: {len(returns)} episodes, mean return {mean:.2f}")
envs.close()
