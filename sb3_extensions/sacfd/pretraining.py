"""Pretraining of SACfD's actor, and the parts of an update that it shares with ``train()``."""

from collections import defaultdict
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor

from sb3_extensions.demonstrations.off_policy import Logs, OffPolicyFromDemonstrations
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.sacfd.losses import imitation_loss
from sb3_extensions.sacfd.policies import SACfDPolicy


class ActorPretraining(OffPolicyFromDemonstrations):
    """Pretraining that updates the actor alone by the imitation term, then everything."""

    actor: Actor
    critic_warmup_steps: int | None
    bc_weight: float
    bc_limit: float

    @property
    def _warmup_steps(self) -> int:
        return self.pretrain_steps if self.critic_warmup_steps is None else self.critic_warmup_steps

    def _pretrain_once(self) -> None:
        if self.pretraining_left > self._warmup_steps:
            self._imitate()
        else:
            super()._pretrain_once()

    def _imitate(self) -> None:
        """Update the actor by the imitation term alone."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.actor.optimizer)
        logs: Logs = defaultdict(list)
        replay_data = self._sample(self.batch_size, logs)
        actions_pi, _ = self._action_log_prob(self._features(self.actor, replay_data.observations))
        bc_loss = imitation_loss(actions_pi, replay_data, th.zeros_like(replay_data.rewards), self.bc_limit)
        self.actor.optimizer.zero_grad()
        (self.bc_weight * bc_loss).backward()
        self.actor.optimizer.step()
        self._update_actor_average()
        logs["bc_loss"].append(bc_loss.detach())
        self._log_updates(1, logs)

    def _features(self, network: Any, observations: PyTorchObs) -> th.Tensor:
        """Return the features of an actor or a critic, (batch, features_dim)."""
        features: th.Tensor = network.extract_features(observations, network.features_extractor)
        return features

    def _action_log_prob(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Sample the actor's actions; return them and their log probabilities, (batch, 1)."""
        latent_pi = self.actor.latent_pi(features)
        log_std = self.actor.log_std(latent_pi).clamp(LOG_STD_MIN, LOG_STD_MAX)  # type: ignore[operator]
        actions, log_prob = self.actor.action_dist.log_prob_from_params(  # type: ignore[call-arg]
            self.actor.mu(latent_pi), log_std
        )
        return actions, log_prob.reshape(-1, 1)

    def _sample(self, batch_size: int, logs: Logs) -> ExpertReplayBufferSamples:
        """Sample the replay buffer, train the encoder on the observations alone, augment the sample."""
        assert self.replay_buffer is not None
        replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        for name, value in self._update_encoder(replay_data.observations).items():
            logs[name].append(value)
        if self.augmentation is not None:
            replay_data = self.augmentation(replay_data, self.augmentation_generator)
        return replay_data

    def _update_encoder(self, observations: PyTorchObs) -> dict[str, th.Tensor]:
        """Train an encoder on observations alone; return the losses by name. SACfD trains none."""
        return {}

    def _update_actor_average(self) -> None:
        if isinstance(self.policy, SACfDPolicy):
            self.policy.update_average()
