"""Soft actor-critic from demonstrations."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.sac.sac import SAC
from tqdm import tqdm

from sb3_extensions.common.augmentation import AugmentationSpec, make_augmentation
from sb3_extensions.common.expert import EpisodeData, collect_episodes, make_expert_env
from sb3_extensions.common.expert_replay import ExpertReplayBuffer
from sb3_extensions.common.gradients import frozen
from sb3_extensions.common.seeds import SeedKey, derive_seed
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy

SelfSACfD = TypeVar("SelfSACfD", bound="SACfD")


class SACfD(SAC):
    """
    Soft actor-critic from demonstrations (SACfD).

    SAC whose replay buffer begins with the episodes of an expert, and whose actor is also drawn to the
    expert's actions: its loss has the additional term ``bc_weight * MSE(sampled action, expert action)``, the
    mean over the expert transitions of the batch and all action dimensions, in the policy's units [-1, 1].
    With ``bc_weight=0`` and ``expert_episodes=0`` it is SAC.

    Paper: https://arxiv.org/abs/2205.14292 (BulletArm, Section "Close-Loop 4D Benchmark"); the defaults are
    its parameters. SAC: https://arxiv.org/abs/1801.01290. With an ``augmentation`` it is RAD or DrQ SACfD.

    The demonstrations are collected at the first ``learn()`` in an environment of their own, made from the
    spec of the training environment; these steps do not count as timesteps.

    :param policy: The policy model to use (``"MultiInputPolicy"``, ``"EquivariantPolicy"``, or a class)
    :param env: The environment to learn from (if registered in Gym, can be str); its observations are a Dict
    :param learning_rate: learning rate for adam optimizer,
        the same learning rate will be used for all networks (Q-Values, Actor and entropy coefficient)
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: number of transitions in the replay buffer, demonstrations included
    :param learning_starts: how many steps of the model to collect transitions for before learning starts;
        they are taken at random
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency
        and unit like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: the action noise type (None by default), this can help
        for hard exploration problem. Cf common.noise for the different action noise type.
    :param replay_buffer_class: Replay buffer class, ``ExpertReplayBuffer`` (the default) or a subclass
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation;
        ``n_steps`` and ``gamma`` of this class are passed on besides
    :param n_steps: number of rewards that are summed up before the bootstrap
    :param ent_coef: Entropy regularization coefficient. (Equivalent to
        inverse of reward scale in the original SAC paper.)  Controlling exploration/exploitation trade-off.
        Set it to 'auto' to learn it automatically (and 'auto_0.1' for using 0.1 as initial value)
    :param target_update_interval: update the target network every ``target_network_update_freq``
        gradient steps.
    :param target_entropy: target entropy when learning ``ent_coef`` (``ent_coef = 'auto'``);
        'auto' is minus the number of action dimensions
    :param bc_weight: weight of the behaviour cloning term in the actor's loss
    :param expert_episodes: number of successful episodes of the expert to begin with, unless ``expert_data``
        is given
    :param expert_data: episodes to begin with instead, with Minari's attributes
        (see :class:`~sb3_extensions.common.expert.EpisodeData`), in the environment's units; not saved
    :param augmentation: random views of the images: None, a :class:`~sb3_extensions.common.augmentation.RAD`
        or :class:`~sb3_extensions.common.augmentation.DrQ`, or in YAML ``"drq"``, ``{"rad": {"size": 128}}``
    :param pretrain_steps: number of gradient steps before the first step in the environment
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to
        average the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used),
        2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if ``bc_weight``, ``expert_episodes`` or ``pretrain_steps`` is negative, or
        ``replay_buffer_class`` is no ``ExpertReplayBuffer``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "EquivariantPolicy": EquivariantPolicy,
    }
    action_space: spaces.Box
    replay_buffer: ExpertReplayBuffer | None

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
        expert_data: Iterable[EpisodeData] | None = None,
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
        replay_buffer_class = replay_buffer_class or ExpertReplayBuffer
        if not issubclass(replay_buffer_class, ExpertReplayBuffer):
            raise ValueError(f"replay_buffer_class must be an ExpertReplayBuffer, got {replay_buffer_class}")
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
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
        given = {"bc_weight": bc_weight, "expert_episodes": expert_episodes, "pretrain_steps": pretrain_steps}
        for name, value in given.items():
            if value < 0:
                raise ValueError(f"{name} must not be negative, got {value}")
        # The base class ignores n_steps and gamma when a buffer class is given, see GH #2274
        self.replay_buffer_kwargs = {"n_steps": n_steps, "gamma": gamma, **self.replay_buffer_kwargs}
        self.bc_weight = bc_weight
        self.expert_episodes = expert_episodes
        self.expert_data = expert_data
        self.augmentation = make_augmentation(augmentation)
        self.augmentation_generator = th.Generator().manual_seed(th.initial_seed())
        self.pretrain_steps = pretrain_steps

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if self.augmentation is not None:
            self.augmentation.check(self.observation_space)
            self.policy_kwargs = self.augmentation.with_crop(self.policy_kwargs)
        super()._setup_model()
        # Nothing learns through the target. Its forward pass turns gradients on again inside no_grad, see
        # ContinuousCritic.forward, and its encoder would keep everything for a backward pass
        self.critic_target.requires_grad_(False)
        # The base class seeds before it makes the buffer
        self._seed_samplers(self.seed)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seed of the pseudo-random generators
        (python, numpy, pytorch, gym, action_space, replay buffer, augmentation)

        :param seed:
        """
        super().set_random_seed(seed)
        self._seed_samplers(seed)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        if self.replay_buffer is not None:
            self.replay_buffer.progress_remaining = self._current_progress_remaining

    def _seed_samplers(self, seed: int | None) -> None:
        if seed is not None:
            self.augmentation_generator.manual_seed(derive_seed(seed, SeedKey.AUGMENTATION))
            if self.replay_buffer is not None:
                self.replay_buffer.seed(seed)

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
                # Compute the next Q values: min over all critics targets
                next_q_values = th.cat(self.critic_target(next_observations, next_actions), dim=1)
                next_q_values, _ = th.min(next_q_values, dim=1, keepdim=True)
                # add entropy term
                next_q_values = next_q_values - ent_coef * next_log_prob.reshape(-1, 1)
                if self.augmentation is not None:
                    next_q_values = self.augmentation.average_targets(next_q_values)
                # td error + entropy term; the discount is gamma**n where n steps are summed up
                assert replay_data.discounts is not None
                bootstrap = (1 - replay_data.dones) * replay_data.discounts * next_q_values
                target_q_values = replay_data.rewards + bootstrap

            # Current Q-values estimates for each critic network, using action from the replay buffer
            current_q_values = self.critic(observations, replay_data.actions)
            td_errors = [current_q - target_q_values for current_q in current_q_values]
            critic_loss = 0.5 * th.stack([(replay_data.weights * e.pow(2)).mean() for e in td_errors]).sum()
            # Mean over the critics, and over the views of each observation if there are more
            priorities = th.stack(td_errors).detach().abs().view(-1, len(replay_data.indices), 1).mean(dim=0)
            self.replay_buffer.update_priorities(replay_data.indices, priorities)

            # Optimize the critic
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()

            # Min over all critic networks. The critic is frozen: of its gradients only the one with respect
            # to the actions is needed, and its encoder then keeps nothing for a backward pass
            with frozen(self.critic):
                q_values_pi = th.cat(self.critic(observations, actions_pi), dim=1)
            min_qf_pi, _ = th.min(q_values_pi, dim=1, keepdim=True)
            actor_loss = (ent_coef * log_prob - min_qf_pi).mean()
            logs["actor_loss"].append(actor_loss.detach())
            if self.bc_weight > 0:
                # Mean over the expert transitions alone; 0 if there are none in the batch
                is_expert = replay_data.is_expert
                squared_errors = (actions_pi - replay_data.actions).pow(2).mean(dim=1, keepdim=True)
                bc_loss = (squared_errors * is_expert).sum() / is_expert.sum().clamp(min=1)
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

    def learn(
        self: SelfSACfD,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSACfD:
        """
        Return a trained model; the first call adds the demonstrations and pretrains.

        :param total_timesteps: The total number of samples (env steps) to train on, without demonstrations
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: the number of episodes before logging
        :param tb_log_name: the name of the run for TensorBoard logging; that of the class if ``None``
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained model
        """
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.replay_buffer is not None
        if not self.replay_buffer.size():
            self._add_demonstrations()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self._n_updates == 0:
            for _ in tqdm(range(self.pretrain_steps), desc="pretraining", disable=not self.pretrain_steps):
                self.train(1, self.batch_size)
        return total_timesteps, callback

    def _add_demonstrations(self) -> None:
        """Fill the expert rows of the replay buffer, from ``expert_data`` or by collecting episodes."""
        if self.expert_data is not None:
            self._add_episodes(self.expert_data)
        elif self.expert_episodes > 0:
            assert self.env is not None, "You must set the environment before calling learn()"
            seed = None if self.seed is None else derive_seed(self.seed, SeedKey.EXPERT)
            with contextlib.closing(make_expert_env(self.env)) as expert_env:
                self._add_episodes(collect_episodes(expert_env, self.expert_episodes, seed))

    def _add_episodes(self, episodes: Iterable[EpisodeData]) -> None:
        assert self.replay_buffer is not None
        for episode in episodes:
            # The environments clip, so a clipped action is the one that was carried out
            actions = np.clip(episode.actions, self.action_space.low, self.action_space.high)
            self.replay_buffer.add_episode(
                episode.observations,
                self.policy.scale_action(actions),
                episode.rewards,
                episode.terminations,
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "expert_data", "augmentation_generator"]
