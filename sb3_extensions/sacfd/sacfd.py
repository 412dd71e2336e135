"""Soft actor-critic from demonstrations."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.sac.sac import SAC

from sb3_extensions.common.augmentation import AugmentationSpec, make_augmentation
from sb3_extensions.common.gradients import frozen
from sb3_extensions.demonstrations.collecting import EpisodeData
from sb3_extensions.demonstrations.off_policy import check_not_negative, check_share
from sb3_extensions.sacfd.averaging import AveragedActorPolicy, with_average
from sb3_extensions.sacfd.exploration import Exploration
from sb3_extensions.sacfd.imitation import imitated_actions, value_weights
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy, StatePolicy


class SACfD(Exploration, SAC):
    """
    Soft actor-critic from demonstrations (SACfD).

    SAC whose replay buffer begins with the episodes of an expert, and whose actor imitates the expert: its
    loss has the term ``bc_weight * MSE(sampled action, expert action)``, the weighted mean over the imitated
    transitions, in the policy's units [-1, 1]. With ``bc_weight``, ``expert_episodes`` and ``exploration`` 0,
    ``n_steps=1`` and ``backup_entropy=True`` it is SAC, with an ``augmentation`` it is RAD or DrQ SACfD.

    The demonstrations are collected at the beginning of the first ``learn()``, in an environment of their own
    made from the spec of the training environment; these steps do not count as timesteps.

    Paper: https://arxiv.org/abs/2205.14292 (close-loop 4D benchmark); SAC: https://arxiv.org/abs/1801.01290

    :param policy: The policy model to use (one of the aliases, or a class)
    :param env: The environment to learn from (if registered in Gym, can be str); its observations are a Dict
    :param learning_rate: learning rate for adam optimizer, the same for all networks (Q-Values, Actor and
        entropy coefficient); it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: number of transitions in the replay buffer, demonstrations included
    :param learning_starts: how many steps to take at random before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every so many steps, or ``(2, "episode")``
    :param gradient_steps: How many gradient steps to do after each rollout; ``-1`` as many as it has steps
    :param action_noise: the action noise type (None by default), see SB3's common.noise
    :param replay_buffer_class: Replay buffer class, ``ExpertReplayBuffer`` (the default) or a subclass
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation; its ``n_steps``
        and ``gamma`` are the algorithm's, its ``image_dtype`` is what the features extractor rounds to
    :param n_steps: number of rewards summed up before the bootstrap, fewer before an exploratory action
    :param ent_coef: Entropy regularization coefficient, controlling exploration/exploitation trade-off;
        'auto' learns it ('auto_0.1' from an initial value of 0.1)
    :param target_update_interval: update the target network every so many gradient steps.
    :param target_entropy: when learning ``ent_coef``; 'auto' is minus the number of action dimensions
    :param bc_weight: weight of the behaviour cloning term in the actor's loss
    :param bc_limit: imitated actions are clipped to [-bc_limit, bc_limit]: towards 1 the mean of a squashed
        Gaussian grows without end, and what has grown cannot be unlearned
    :param self_imitation: imitate the agent's own transitions as well from which it succeeded without another
        exploratory action (with a return greater than 0), with a weight of ``exp((value of the action - value
        of the actor's action) / self_imitation)``, at most that of the expert's, 1. What was won is then kept
        where the critic errs. None imitates the expert alone, as the paper does.
        Self-imitation: https://arxiv.org/abs/1806.05635, the weight: https://arxiv.org/abs/2006.15134
    :param q_weight: weight of the critic's values in the actor's loss
    :param expert_q_weight: that in the expert's transitions, None as ``q_weight``. With 0 the actor imitates
        there and follows its critic in its own states only, so that the pretraining is plain imitation
    :param backup_entropy: whether the entropy of the next action is part of the critic's target
    :param value_range: least and greatest possible return: the target critic's values are clipped to it
    :param actor_tau: soft update coefficient of the average of the actor's weights that acts where actions
        are not sampled, see :class:`~sb3_extensions.sacfd.averaging.AveragedActorPolicy`; None keeps none
    :param exploration: probability with which one number of an action is drawn from its whole range: where an
        agent always does the same, its critic learns of nothing else
    :param greedy_fraction: fraction of episodes of deterministic actions: what holds these, samples escape
    :param expert_episodes: number of successful episodes of the expert to begin with, if no ``expert_data``
    :param expert_noise: standard deviation of a normal error with which the expert's actions are carried out,
        in the policy's units [-1, 1], see :class:`~sb3_extensions.demonstrations.noise.UnsteadyHand`
    :param expert_data: episodes to begin with instead, in the environment's units; not saved. See
        :class:`~sb3_extensions.demonstrations.collecting.EpisodeData`
    :param dagger: ask the environment's expert before every step as well: it does not act, but is imitated in
        the agent's own states too; not part of the paper. DAgger: https://arxiv.org/abs/1011.0686
    :param augmentation: random views of the images: None, :class:`~sb3_extensions.common.augmentation.RAD` or
        :class:`~sb3_extensions.common.augmentation.DrQ`, or in YAML ``"drq"``, ``{"rad": {"size": 128}}``
    :param pretrain_steps: number of gradient steps before the first step in the environment
    :param stats_window_size: number of episodes over which the rollout logging averages
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: arguments of the policy
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run; auto takes a GPU if possible
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of its range, if there is pretraining without demonstrations,
        if ``dagger`` has no weight or the environment no ``expert_action()`` for it, if
        ``replay_buffer_class`` is no ``ExpertReplayBuffer``, or rounds images otherwise than the policy
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
        n_steps: int = 10,
        ent_coef: str | float = 0.005,
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        bc_weight: float = 10.0,
        bc_limit: float = 0.95,
        self_imitation: float | None = 0.1,
        q_weight: float = 1.0,
        expert_q_weight: float | None = None,
        backup_entropy: bool = False,
        value_range: tuple[float, float] | None = None,
        actor_tau: float | None = None,
        exploration: float = 0.1,
        greedy_fraction: float = 0.0,
        expert_episodes: int = 100,
        expert_noise: float = 0.0,
        expert_data: Iterable[EpisodeData] | None = None,
        dagger: bool = False,
        augmentation: AugmentationSpec = None,
        pretrain_steps: int = 0,
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
        self.bc_limit = bc_limit
        self.self_imitation = self_imitation
        self.q_weight = q_weight
        self.expert_q_weight = expert_q_weight
        self.backup_entropy = backup_entropy
        self.value_range = value_range
        self.actor_tau = actor_tau
        self.exploration = exploration
        self.greedy_fraction = greedy_fraction
        self.exploration_generator = th.Generator().manual_seed(th.initial_seed())
        self.expert_episodes = expert_episodes
        self.expert_noise = expert_noise
        self.expert_data = expert_data
        self.dagger = dagger
        self.augmentation = make_augmentation(augmentation)
        self.augmentation_generator = th.Generator().manual_seed(th.initial_seed())
        self.pretrain_steps = pretrain_steps
        self._check_arguments()

        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        self._check_demonstrations()
        check_not_negative(
            bc_weight=self.bc_weight, q_weight=self.q_weight, expert_q_weight=self.expert_q_weight
        )
        check_share(
            bc_limit=self.bc_limit, exploration=self.exploration, greedy_fraction=self.greedy_fraction
        )
        if self.self_imitation is not None and self.self_imitation <= 0:
            raise ValueError(f"self_imitation must be None or greater than 0, got {self.self_imitation}")
        if self.value_range is not None and not self.value_range[0] < self.value_range[1]:
            raise ValueError(f"value_range must be None or (least, greatest), got {self.value_range}")
        if self.actor_tau is not None and not 0 < self.actor_tau <= 1:
            raise ValueError(f"actor_tau must be None or greater than 0 and at most 1, got {self.actor_tau}")
        if self.dagger and self.bc_weight == 0:
            raise ValueError("dagger=True needs a bc_weight greater than 0, got 0")

    def _setup_model(self) -> None:
        self.policy_kwargs = with_average(self.policy_class, self.policy_kwargs, self.actor_tau)
        super()._setup_model()
        # Nothing learns through the target, and its encoder would keep everything for a backward pass
        self.critic_target.requires_grad_(False)

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
            ent_coef = self._update_ent_coef(log_prob, logs)

            with th.no_grad():
                next_q_values = self._next_values(next_observations, ent_coef)
                # td error + entropy term; the discount is gamma**n where n steps are summed up
                assert replay_data.discounts is not None
                bootstrap = (1 - replay_data.dones) * replay_data.discounts * next_q_values
                target_q_values = replay_data.rewards + bootstrap

            # Current estimates of the critics, for the actions from the replay buffer
            features = self._features(self.critic, observations)
            estimates = self._estimates(self.critic, features, replay_data.actions)
            critic_loss, td_errors = self._critic_loss(estimates, target_q_values, replay_data.weights)
            # Mean over the views of each observation if there are more
            td_errors = td_errors.view(-1, len(replay_data.indices), 1).mean(dim=0)
            self.replay_buffer.update_priorities(replay_data.indices, td_errors)

            # The critic is frozen: of its gradients only the one with respect to the actions is needed.
            # Its features of the same observations serve again
            with frozen(self.critic):
                estimates_pi = self._estimates(self.critic, features.detach(), actions_pi)
            q_values_pi = self._values(estimates_pi)
            q_weights = value_weights(replay_data.is_expert, self.q_weight, self.expert_q_weight)
            actor_loss = (ent_coef * log_prob - q_weights * q_values_pi).mean()
            logs["actor_loss"].append(actor_loss.detach())
            if self.bc_weight > 0:
                # Mean over the transitions with an action to imitate; 0 if there are none in the batch
                advantages = (self._means(estimates) - self._means(estimates_pi)).detach()
                imitated, bc_weights = imitated_actions(
                    replay_data, advantages, self.self_imitation, self.bc_limit
                )
                errors = (actions_pi - imitated).pow(2).mean(dim=1, keepdim=True)
                bc_loss = (errors * bc_weights).sum() / bc_weights.sum().clamp(min=1)
                actor_loss = actor_loss + self.bc_weight * bc_loss
                logs["bc_loss"].append(bc_loss.detach())

            # Optimize the critic and the actor
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.actor.optimizer.zero_grad()
            actor_loss.backward()
            self.critic.optimizer.step()
            self.actor.optimizer.step()

            self._update_targets(self._n_updates + gradient_step)

            logs["ent_coef"].append(ent_coef.detach())
            logs["critic_loss"].append(critic_loss.detach())
            # What the critic expects, how unsure the actor is: where the expert was, where the agent was
            with th.no_grad():
                for name, numbers in (("value", self._values(estimates)), ("entropy", -log_prob)):
                    logs[f"{name}_expert"].append(numbers[replay_data.is_expert])
                    logs[f"{name}_own"].append(numbers[~replay_data.is_expert])

        self._n_updates += gradient_steps

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, losses in logs.items():
            if len(values := th.cat([loss.reshape(-1) for loss in losses])):
                self.logger.record(f"train/{name}", values.mean().item())

    def _update_ent_coef(self, log_prob: th.Tensor, logs: dict[str, list[th.Tensor]]) -> th.Tensor:
        """Do one step on the entropy coefficient, if it is learned; returns what it was before."""
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            return self.ent_coef_tensor
        # Important: detach the variable from the graph
        # so we don't change it with other losses
        # see https://github.com/rail-berkeley/softlearning/issues/60
        ent_coef = th.exp(self.log_ent_coef.detach())
        assert isinstance(self.target_entropy, float)
        ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
        self.ent_coef_optimizer.zero_grad()
        ent_coef_loss.backward()
        self.ent_coef_optimizer.step()
        logs["ent_coef_loss"].append(ent_coef_loss.detach())
        return ent_coef

    def _next_values(self, next_observations: PyTorchObs, ent_coef: th.Tensor) -> th.Tensor:
        """Values of the actor's actions in the next states, by the target critic."""
        # Select action according to policy
        next_actions, next_log_prob = self.actor.action_log_prob(next_observations)
        features = self._features(self.critic_target, next_observations)
        next_q_values = self._target_values(self._estimates(self.critic_target, features, next_actions))
        if self.value_range is not None:
            next_q_values = next_q_values.clamp(*self.value_range)
        if self.backup_entropy:
            # add entropy term
            next_q_values = next_q_values - ent_coef * next_log_prob.reshape(-1, 1)
        if self.augmentation is not None:
            next_q_values = self.augmentation.average_targets(next_q_values)
        return next_q_values

    def _features(self, critic: Any, observations: PyTorchObs) -> th.Tensor:
        """Features of a critic; those that it shares with the actor learn from the actor's loss alone."""
        with th.set_grad_enabled(th.is_grad_enabled() and not self.policy.share_features_extractor):
            features: th.Tensor = critic.extract_features(observations, critic.features_extractor)
        return features

    def _estimates(self, critic: Any, features: th.Tensor, actions: th.Tensor) -> Any:
        """What the heads of a critic say, one entry a head."""
        head_input = th.cat([features, actions], dim=1)
        return [head(head_input) for head in critic.q_networks]

    def _update_encoder(self, observations: PyTorchObs) -> dict[str, th.Tensor]:
        """Learn from sampled observations alone, here nothing; returns the losses by name."""
        return {}

    def _update_targets(self, n_updates: int) -> None:
        """Update target networks, and the actor's average."""
        if n_updates % self.target_update_interval == 0:
            self._update_target_critic()
            # Copy running stats, see GH issue #996
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        if self.actor_tau is not None:
            assert isinstance(self.policy, AveragedActorPolicy)
            self.policy.update_average(self.actor_tau, n_updates)

    def _update_target_critic(self) -> None:
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)

    def _target_values(self, estimates: Any) -> th.Tensor:
        """Values or quantiles to bootstrap from, of what the target critic says, (batch, number of them)."""
        return self._values(estimates)

    def _critic_loss(
        self, estimates: Any, targets: th.Tensor, weights: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Loss of the critic, and absolute errors without gradient, means over the heads, (batch, 1)."""
        td_errors = [q_values - targets for q_values in estimates]
        loss = 0.5 * th.stack([(weights * error.pow(2)).mean() for error in td_errors]).sum()
        return loss, th.stack(td_errors).detach().abs().mean(dim=0)

    def _means(self, estimates: Any) -> th.Tensor:
        """Values to compare actions by, (batch, 1): heads differ the more the farther from the data."""
        return th.cat(estimates, dim=1).mean(dim=1, keepdim=True)

    def _values(self, estimates: Any) -> th.Tensor:
        """Values that the actor maximises, of what the critic says, (batch, 1)."""
        # Min over all critic networks
        return th.cat(estimates, dim=1).min(dim=1, keepdim=True).values
