"""Soft actor-critic from demonstrations."""

from collections import defaultdict
from functools import partial
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, SACPolicy
from stable_baselines3.sac.sac import SAC
from torch import nn

from sb3_extensions.common.components import check_entropy, check_integer, check_not_negative
from sb3_extensions.common.entropy import replace_ent_coef
from sb3_extensions.demonstrations.collection import ActionTransform, add_noise
from sb3_extensions.demonstrations.off_policy import Logs, OffPolicyFromDemonstrations
from sb3_extensions.demonstrations.validation import ExpertData
from sb3_extensions.replay.rotation import AugmentationSpec, make_augmentation
from sb3_extensions.replay.samples import ExpertReplayBufferSamples, compute_next_values
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy, SACfDPolicy, StatePolicy

SelfSACfD = TypeVar("SelfSACfD", bound="SACfD")


def imitation_loss(actions: th.Tensor, expert_actions: th.Tensor) -> th.Tensor:
    """
    Mean squared error of actions to the expert's actions, over the steps with a known expert action.

    :param actions: sampled actions of the actor in the policy's units, (batch, action dimensions)
    :param expert_actions: NaN if unknown, (batch, action dimensions)
    :return: a scalar, 0 without expert actions
    """
    known = expert_actions.isfinite().all(dim=1, keepdim=True)
    errors = (actions - th.where(known, expert_actions, actions)).pow(2).mean(dim=1)
    return errors.sum() / known.sum().clamp(min=1)


class SACfD(OffPolicyFromDemonstrations, SAC):
    """
    Soft actor-critic from demonstrations (SACfD).

    SAC whose replay buffer starts with the episodes of an expert and whose actor imitates the expert: its
    loss has the term ``bc_weight * MSE(sampled action, expert action)``, the mean over the expert steps of a
    batch in the policy's units [-1, 1]. With default arguments it is the algorithm of the paper. With
    ``bc_weight`` and ``expert_episodes`` 0 it is SAC; with an ``augmentation`` it is RAD or DrQ SACfD.

    The first ``learn()`` collects the demonstrations in copies of the training environments. Their steps do
    not count as timesteps.

    Paper: https://arxiv.org/abs/2205.14292 (Close-Loop 4D Benchmark); SAC: https://arxiv.org/abs/1801.01290

    See Stable-Baselines3's ``SAC`` for the parameters that are not documented here.

    :param policy: The policy model to use (one of the aliases, or a class)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param buffer_size: number of rows of the replay buffer, demonstrations included, see
        :class:`~sb3_extensions.replay.buffer.ExpertReplayBuffer`
    :param replay_buffer_class: Replay buffer class, ``ExpertReplayBuffer`` (the default) or a subclass
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation. ``n_steps`` and
        ``gamma`` are arguments of the algorithm, ``image_dtype`` is by default as in the extractor
    :param n_steps: maximum number of rewards in a return before the bootstrap
    :param bc_weight: weight of the imitation term in the actor's loss
    :param expert_episodes: number of successful episodes of the expert, if ``expert_data`` is None
    :param expert_data: episodes in the environment's units instead, or the path of a file of
        ``bulletarm_gym.demonstrations``; not saved with the model. See
        :class:`~sb3_extensions.demonstrations.episodes.EpisodeData`
    :param augmentation: augmentation of the sampled steps: None, ``"rad"``, ``"drq"``, ``"rotation"``, names
        with arguments (``{"rad": {"size": 128}}``), or an
        :class:`~sb3_extensions.replay.augmentation.Augmentation`
    :param expert_noise: standard deviation of Gaussian noise on the expert's executed actions, in the
        policy's units; without effect on ``expert_data``. Source: https://arxiv.org/abs/1703.09327
    :param pretrain_steps: number of updates on the demonstrations before the first step in the environment.
        They update the actor alone, by the imitation term. Source: https://arxiv.org/abs/1709.10087
    :param critic_warmup_steps: number of the last ``pretrain_steps`` that update everything (own addition,
        compare the warm-up of https://arxiv.org/abs/2412.07762). None for all of them
    :raises ValueError: if an argument is out of its range, there is pretraining without demonstrations or
        without ``bc_weight``, or replay buffer and policy round images differently
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "EquivariantPolicy": EquivariantPolicy,
        "StatePolicy": StatePolicy,
    }
    action_space: spaces.Box

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 64,
        tau: float = 0.01,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        n_steps: int = 1,
        ent_coef: str | float = "auto_0.01",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        bc_weight: float = 1.0,
        expert_episodes: int = 100,
        expert_data: ExpertData | None = None,
        augmentation: AugmentationSpec = None,
        expert_noise: float = 0.0,
        pretrain_steps: int = 0,
        critic_warmup_steps: int | None = 0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class or self.default_replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.bc_weight = bc_weight
        self.expert_episodes = expert_episodes
        self.expert_data = expert_data
        self.augmentation = augmentation  # type: ignore[assignment]  # _setup_model() creates the object
        self.expert_noise = expert_noise
        self.pretrain_steps = pretrain_steps
        self.critic_warmup_steps = critic_warmup_steps
        self._check_arguments()

        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        self._check_demonstrations()
        make_augmentation(self.augmentation)
        check_not_negative(bc_weight=self.bc_weight, expert_noise=self.expert_noise)
        check_entropy(ent_coef=self.ent_coef, target_entropy=self.target_entropy)
        check_integer(0, critic_warmup_steps=self._warmup_steps)
        check_integer(1, target_update_interval=self.target_update_interval)
        if self.bc_weight == 0 and self.pretrain_steps > self._warmup_steps:
            raise ValueError(
                "critic_warmup_steps must be None or at least pretrain_steps with bc_weight=0, got "
                f"{self.critic_warmup_steps}"
            )

    @classmethod
    def load(
        cls: type[SelfSACfD], path: Any, *args: Any, ent_coef: str | float | None = None, **kwargs: Any
    ) -> SelfSACfD:
        """
        Load the model from a zip-file, see Stable-Baselines3's ``load()``.

        :param ent_coef: replaces the saved coefficient, which Stable-Baselines3's ``load()`` keeps
        """
        model = super().load(path, *args, **kwargs)
        if ent_coef is not None:
            replace_ent_coef(model, ent_coef)
        return model

    def _setup_model(self) -> None:
        super()._setup_model()
        # The target is not trained; without gradients its encoder keeps no activations.
        self.critic_target.requires_grad_(False)

    def _action_transform(self) -> ActionTransform | None:
        return (
            partial(add_noise, space=self.action_space, std=self.expert_noise) if self.expert_noise else None
        )

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Sample the replay buffer and do the updates
        (gradient descent and update target networks)

        :param gradient_steps: number of updates
        :param batch_size: number of steps in each batch
        """
        assert self.replay_buffer is not None
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]
        self._update_learning_rate(optimizers)

        logs: Logs = defaultdict(list)

        for gradient_step in range(gradient_steps):
            replay_data = self._sample(batch_size, logs)
            observations = replay_data.observations

            # Action by the current actor for the sampled state
            actor_features = self._features(self.actor, observations)
            actions_pi, log_prob = self._action_log_prob(actor_features)

            # Optimize entropy coefficient, also called entropy temperature or alpha in the paper
            ent_coef = self._update_ent_coef(log_prob, logs)

            with th.no_grad():
                # td error + entropy term; the discount is gamma**n for a return of n steps
                target_q_values = replay_data.rewards + self._bootstrap(replay_data, ent_coef)

            # Current Q-values of the critics, for the actions from the replay buffer
            shared = self.policy.share_features_extractor
            features = actor_features if shared else self._features(self.critic, observations)
            q_values = self._q_values(self.critic, features, replay_data.actions)
            critic_loss, td_errors = self._critic_loss(q_values, target_q_values, replay_data.weights)
            # Mean over the views of each observation if there are several
            td_errors = td_errors.view(-1, len(replay_data.indices), 1).mean(dim=0)
            self.replay_buffer.update_priorities(replay_data.indices, td_errors)

            # Only the gradient with respect to the actions is needed: freeze the critic's heads.
            heads = nn.ModuleList(self.critic.q_networks).requires_grad_(False)
            q_values_pi = self._q_values(self.critic, features.detach(), actions_pi)
            heads.requires_grad_(True)
            min_q_pi = self._min_q(q_values_pi)
            actor_loss = (ent_coef * log_prob - min_q_pi).mean()
            logs["actor_loss"].append(actor_loss.detach())
            if self.bc_weight > 0:
                bc_loss = imitation_loss(actions_pi, replay_data.expert_actions)
                actor_loss = actor_loss + self.bc_weight * bc_loss
                logs["bc_loss"].append(bc_loss.detach())

            # Optimize the critic and the actor
            self.critic.optimizer.zero_grad()
            self.actor.optimizer.zero_grad()
            (critic_loss + actor_loss).backward()
            self.critic.optimizer.step()
            self.actor.optimizer.step()

            # Update target networks
            if (self._n_updates + gradient_step) % self.target_update_interval == 0:
                self._update_target_critic()
                # Copy running stats, see GH issue #996
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
            self._update_actor_average()

            logs["ent_coef"].append(ent_coef.detach())
            logs["critic_loss"].append(critic_loss.detach())
            # Mean Q-value and policy entropy, separately for expert and online steps
            with th.no_grad():
                for name, numbers in (("value", self._min_q(q_values)), ("entropy", -log_prob)):
                    logs[f"{name}_expert"].append(numbers[replay_data.is_expert])
                    logs[f"{name}_online"].append(numbers[~replay_data.is_expert])

        self._log_updates(gradient_steps, logs)

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
        bc_loss = imitation_loss(actions_pi, replay_data.expert_actions)
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

    def _update_ent_coef(self, log_prob: th.Tensor, logs: Logs) -> th.Tensor:
        """Update the entropy coefficient if it is learned; return the value before."""
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            return self.ent_coef_tensor
        # Important: detach the variable from the graph so we don't change it with other losses
        ent_coef = th.exp(self.log_ent_coef.detach())
        assert isinstance(self.target_entropy, float)
        ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
        self.ent_coef_optimizer.zero_grad()
        ent_coef_loss.backward()
        self.ent_coef_optimizer.step()
        logs["ent_coef_loss"].append(ent_coef_loss.detach())
        return ent_coef

    def _bootstrap(self, replay_data: ExpertReplayBufferSamples, ent_coef: th.Tensor) -> th.Tensor:
        """Return the discounted next values, 0 at the ends of episodes; (batch, values)."""
        assert replay_data.discounts is not None
        values = compute_next_values(replay_data, partial(self._next_values, ent_coef=ent_coef))
        if self.augmentation is not None and self.augmentation.window is not None:
            values = self.augmentation.window.average_targets(values)
        return (1 - replay_data.dones) * replay_data.discounts * values

    def _next_values(self, next_observations: PyTorchObs, ent_coef: th.Tensor) -> th.Tensor:
        """Return the target critic's values of the actor's actions."""
        # Select action according to policy
        next_actions, next_log_prob = self._action_log_prob(self._features(self.actor, next_observations))
        features = self._features(self.critic_target, next_observations)
        next_q_values = self._target_values(self._q_values(self.critic_target, features, next_actions))
        # add entropy term
        return next_q_values - ent_coef * next_log_prob

    def _q_values(self, critic: Any, features: th.Tensor, actions: th.Tensor) -> Any:
        """Return the outputs of the heads of a critic, one entry a head."""
        head_input = th.cat([features, actions], dim=1)
        return [head(head_input) for head in critic.q_networks]

    def _update_target_critic(self) -> None:
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)

    def _target_values(self, q_values: Any) -> th.Tensor:
        """Return values or quantiles of the target critic, (batch, number of them)."""
        return self._min_q(q_values)

    def _critic_loss(
        self, q_values: Any, targets: th.Tensor, weights: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return the critic's loss and absolute errors without gradient, means over the heads, (batch, 1)."""
        td_errors = [values - targets for values in q_values]
        loss = 0.5 * th.stack([(weights * error.pow(2)).mean() for error in td_errors]).sum()
        return loss, th.stack(td_errors).detach().abs().mean(dim=0)

    def _min_q(self, q_values: Any) -> th.Tensor:
        """Return the values that the actor maximises, (batch, 1)."""
        # Min over all critic networks
        return th.cat(q_values, dim=1).min(dim=1, keepdim=True).values
