"""Updates of soft actor-critic, and of what is built on it, from a replay buffer with demonstrations."""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import polyak_update

from sb3_extensions.common.augmentation import Augmentation
from sb3_extensions.common.expert_replay import ExpertReplayBuffer
from sb3_extensions.common.gradients import frozen

# Mixed into SAC, or TQC, which has the same attributes.
if TYPE_CHECKING:
    from stable_baselines3.sac.sac import SAC as AnySAC
else:
    AnySAC = object


class SoftActorCritic(AnySAC):
    """
    Trains actor, critic and entropy coefficient on random views of weighted transitions, some an expert's.

    What an algorithm makes of the critic's outputs it says by three methods.
    """

    replay_buffer: ExpertReplayBuffer | None
    augmentation: Augmentation | None
    augmentation_generator: th.Generator
    bc_weight: float

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Sample the replay buffer and do the updates
        (gradient descent and update target networks)

        :param gradient_steps: number of updates
        :param batch_size: number of transitions for each
        """
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]
        self._update_learning_rate(optimizers)

        assert self.replay_buffer is not None
        assert isinstance(self.target_entropy, float)
        logs: defaultdict[str, list[th.Tensor]] = defaultdict(list)

        for gradient_step in range(gradient_steps):
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            for name, value in self._update_encoder(replay_data.observations).items():
                logs[name].append(value)
            if self.augmentation is not None:
                replay_data = self.augmentation(replay_data, self.augmentation_generator)
            observations, next_observations = replay_data.observations, replay_data.next_observations

            # Action by the current actor for the sampled state
            actions_pi, log_prob = self.actor.action_log_prob(observations)
            log_prob = log_prob.reshape(-1, 1)

            # Optimize entropy coefficient, also called entropy temperature or alpha in the paper
            if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
                # Important: detach the variable from the graph
                # so we don't change it with other losses
                # see https://github.com/rail-berkeley/softlearning/issues/60
                ent_coef = th.exp(self.log_ent_coef.detach())
                ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
                self.ent_coef_optimizer.zero_grad()
                ent_coef_loss.backward()
                self.ent_coef_optimizer.step()
                logs["ent_coef_loss"].append(ent_coef_loss.detach())
            else:
                ent_coef = self.ent_coef_tensor

            with th.no_grad():
                # Select action according to policy
                next_actions, next_log_prob = self.actor.action_log_prob(next_observations)
                next_q_values = self._target_values(self.critic_target(next_observations, next_actions))
                # add entropy term
                next_q_values = next_q_values - ent_coef * next_log_prob.reshape(-1, 1)
                if self.augmentation is not None:
                    next_q_values = self.augmentation.average_targets(next_q_values)
                # td error + entropy term; the discount is gamma**n where n steps are summed up
                assert replay_data.discounts is not None
                bootstrap = (1 - replay_data.dones) * replay_data.discounts * next_q_values
                target_q_values = replay_data.rewards + bootstrap

            # Current estimates of the critics, for the actions from the replay buffer
            critic_loss, td_errors = self._critic_loss(
                self.critic(observations, replay_data.actions), target_q_values, replay_data.weights
            )
            # Mean over the views of each observation if there are more
            td_errors = td_errors.view(-1, len(replay_data.indices), 1).mean(dim=0)
            self.replay_buffer.update_priorities(replay_data.indices, td_errors)

            # Optimize the critic
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()

            # The critic is frozen: of its gradients only the one with respect to the actions is needed, and
            # its encoder then keeps nothing for a backward pass
            with frozen(self.critic):
                q_values_pi = self._values(self.critic(observations, actions_pi))
            actor_loss = (ent_coef * log_prob - q_values_pi).mean()
            logs["actor_loss"].append(actor_loss.detach())
            if self.bc_weight > 0:
                # Mean over the transitions with an expert's action; 0 if there are none in the batch
                known = replay_data.expert_actions.isfinite().all(dim=1, keepdim=True)
                errors = actions_pi - replay_data.expert_actions.nan_to_num()
                bc_loss = (errors.pow(2).mean(dim=1, keepdim=True) * known).sum() / known.sum().clamp(min=1)
                actor_loss = actor_loss + self.bc_weight * bc_loss
                logs["bc_loss"].append(bc_loss.detach())

            # Optimize the actor
            self.actor.optimizer.zero_grad()
            actor_loss.backward()
            self.actor.optimizer.step()

            # Update target networks
            if gradient_step % self.target_update_interval == 0:
                self._update_target_critic()
                # Copy running stats, see GH issue #996
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

            logs["ent_coef"].append(ent_coef.detach())
            logs["critic_loss"].append(critic_loss.detach())

        self._n_updates += gradient_steps

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in logs.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())

    def _update_encoder(self, observations: PyTorchObs) -> dict[str, th.Tensor]:
        """Learn from sampled observations alone, here nothing; returns the losses by name."""
        return {}

    def _update_target_critic(self) -> None:
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)

    @abstractmethod
    def _target_values(self, estimates: Any) -> th.Tensor:
        """Values or quantiles to bootstrap from, of what the target critic says, (batch, number of them)."""

    @abstractmethod
    def _critic_loss(
        self, estimates: Any, targets: th.Tensor, weights: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Loss of the critic.

        :param estimates: what the critic says
        :param targets: shape (batch, number of values or quantiles)
        :param weights: of the transitions, shape (batch, 1)
        :return: the loss; absolute errors without gradient, means over the critics, (batch, 1)
        """

    @abstractmethod
    def _values(self, estimates: Any) -> th.Tensor:
        """Values that the actor maximises, of what the critic says, (batch, 1)."""
