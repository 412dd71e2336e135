"""Deep Q-learning over spatial action maps, from demonstrations."""

from collections import defaultdict
from functools import partial
from typing import Any, ClassVar

import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import LinearSchedule, polyak_update
from torch.nn import functional as F

from sb3_extensions.common.components import (
    check_fraction,
    check_integer,
    check_not_negative,
    check_positive,
)
from sb3_extensions.demonstrations.collection import ActionTransform
from sb3_extensions.demonstrations.off_policy import Logs, OffPolicyFromDemonstrations
from sb3_extensions.demonstrations.validation import ExpertData
from sb3_extensions.replay.samples import compute_next_values
from sb3_extensions.spatial_dqn.augmentation import RigidMotion
from sb3_extensions.spatial_dqn.codec import explore_on_grid, snap_to_grid
from sb3_extensions.spatial_dqn.losses import ImitationLoss, cross_entropy, large_margin, strict_margin
from sb3_extensions.spatial_dqn.policies import (
    ASRPolicy,
    EquivariantASRPolicy,
    EquivariantFCNPolicy,
    FCNPolicy,
    RotFCNPolicy,
    SpatialPolicy,
)


class SpatialDQN(OffPolicyFromDemonstrations):
    """
    Deep Q-learning (DQN) with actions on a grid over a heightmap: pixel, yaw, height and tilts of a gripper.

    The environment's actions are a Box. A :class:`~sb3_extensions.spatial_dqn.codec.SpatialActionCodec`
    converts them to the grid. Greedy actions, exploration and demonstrations are on the grid. The network
    values all actions at once, or in levels that choose one number after the other. Every level learns the
    same target.

    Half of each batch are expert steps, as soon as there is half a batch of expert and of online steps.
    Before, all steps are sampled with equal probability. This class does not imitate the expert steps;
    :class:`ADET`, :class:`DQfD` and :class:`SDQfD` do.

    Paper: https://arxiv.org/abs/2205.14292, Section "Open-Loop 3D Benchmark", and
    https://arxiv.org/abs/2010.02798

    See Stable-Baselines3's ``DQN`` for the parameters that are not documented here.

    :param env: The environment to learn from (if registered in Gym, can be str), with Dict observations that
        contain a heightmap and Box actions
    :param replay_buffer_class: Replay buffer class, ``ExpertReplayBuffer`` (the default) or a subclass
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation, except
        ``n_steps`` and ``gamma``. ``image_dtype`` defaults to the policy's ``quantise``, ``sampler`` to half
        expert steps
    :param n_steps: number of rewards in the target before the bootstrap
    :param target_update_interval: number of gradient steps between updates of the target network
    :param imitation_weight: weight of the imitation loss of a subclass. None for the paper's: 0.01 for
        :class:`ADET`, otherwise 0.1
    :param margin: margin of the imitation loss of :class:`DQfD` and :class:`SDQfD`
    :param max_grad_value: maximum absolute value of each number of the gradient
    :param expert_episodes: number of successful expert episodes to collect, without ``expert_data``
    :param expert_data: see :class:`~sb3_extensions.sacfd.SACfD`
    :param augmentation: augmentation of the sampled steps: None or ``"rigid_motion"``, see
        :class:`~sb3_extensions.spatial_dqn.augmentation.RigidMotion`
    :param pretrain_steps: number of gradient steps before the first step in the environment
    :raises ValueError: if an argument is out of its range, ``pretrain_steps`` is positive without
        demonstrations, or ``replay_buffer_class`` is not an ``ExpertReplayBuffer``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "FCNPolicy": FCNPolicy,
        "RotFCNPolicy": RotFCNPolicy,
        "EquivariantFCNPolicy": EquivariantFCNPolicy,
        "ASRPolicy": ASRPolicy,
        "EquivariantASRPolicy": EquivariantASRPolicy,
    }
    default_imitation_weight: ClassVar[float] = 0.1
    imitation_loss: ImitationLoss | None = None
    """Imitation loss of one level, None without imitation."""
    exploration_schedule: Schedule
    policy: SpatialPolicy

    def __init__(
        self,
        policy: str | type[SpatialPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 16,
        tau: float = 1.0,
        gamma: float = 0.95,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        n_steps: int = 1,
        target_update_interval: int = 100,
        imitation_weight: float | None = None,
        margin: float = 0.1,
        exploration_fraction: float = 0.1,
        exploration_initial_eps: float = 0.0,
        exploration_final_eps: float = 0.0,
        max_grad_value: float = 1.0,
        expert_episodes: int = 200,
        expert_data: ExpertData | None = None,
        augmentation: str | None = None,
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
            replay_buffer_class=replay_buffer_class or self.default_replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            support_multi_env=True,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
        )
        self.target_update_interval = target_update_interval
        default = self.default_imitation_weight
        self.imitation_weight = default if imitation_weight is None else imitation_weight
        self.margin = margin
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_rate = 0.0  # "epsilon" for the epsilon-greedy exploration
        self.max_grad_value = max_grad_value
        self.expert_episodes = expert_episodes
        self.expert_data = expert_data
        if augmentation not in (None, "rigid_motion"):
            raise ValueError(f"augmentation must be None or 'rigid_motion', got {augmentation!r}")
        self.augmentation = augmentation  # type: ignore[assignment]  # _setup_model() creates the object
        self.pretrain_steps = pretrain_steps
        self._check_arguments()

        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        self._check_demonstrations()
        check_not_negative(imitation_weight=self.imitation_weight, margin=self.margin)
        check_fraction(
            exploration_fraction=self.exploration_fraction,
            exploration_initial_eps=self.exploration_initial_eps,
            exploration_final_eps=self.exploration_final_eps,
        )
        check_positive(max_grad_value=self.max_grad_value)
        check_integer(1, target_update_interval=self.target_update_interval)

    def _setup_model(self) -> None:
        is_augmented, self.augmentation = self.augmentation is not None, None
        super()._setup_model()
        self.q_net = self.policy.q_net
        self.q_net_target = self.policy.q_net_target
        self.codec = self.policy.codec
        if is_augmented:
            self.augmentation = RigidMotion(self.codec, self.q_net.scene_view.image_key)
        self.exploration_schedule = LinearSchedule(
            self.exploration_initial_eps, self.exploration_final_eps, self.exploration_fraction
        )

    def _buffer_defaults(self) -> dict[str, Any]:
        # Paper, appendix "Benchmark Details"
        shares = {"expert_fraction": 0.5, "balanced_from": max(1, self.batch_size // 2)}
        return {**super()._buffer_defaults(), "sampler": {"shares": shares}}

    def train(self, gradient_steps: int, batch_size: int = 16) -> None:
        """
        Sample the replay buffer and do the updates (gradient descent and update target networks).

        :param gradient_steps: number of updates
        :param batch_size: number of transitions of each update
        """
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to schedule
        self._update_learning_rate(self.policy.optimizer)

        assert self.replay_buffer is not None
        logs: Logs = defaultdict(list)

        for gradient_step in range(1, gradient_steps + 1):
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            if self.augmentation is not None:
                replay_data = self.augmentation(replay_data, self.augmentation_generator)
            actions = self.codec.encode(replay_data.actions.cpu().numpy())
            indices = th.as_tensor(actions, device=self.device)
            observations = replay_data.observations
            assert isinstance(observations, dict)

            with th.no_grad():
                next_q_values = compute_next_values(replay_data, self._next_values)
                assert replay_data.discounts is not None
                target_q_values = replay_data.rewards + replay_data.discounts * next_q_values

            # Current Q-values of every level, given the choices of the previous levels
            q_values = self.q_net.values(observations, indices)
            choices = self.q_net.choices(indices)
            is_expert = replay_data.is_expert[:, 0]
            loss = th.zeros((), device=self.device)
            for level, (values, chosen) in enumerate(zip(q_values, choices, strict=True)):
                current_q_values = values.gather(1, chosen[:, None])
                # Compute Huber loss (less sensitive to outliers)
                td_errors = F.smooth_l1_loss(current_q_values, target_q_values, reduction="none")
                td_loss = (replay_data.weights * td_errors).mean()
                loss = loss + td_loss
                logs[f"td_loss_{level}"].append(td_loss.detach())
                if self.imitation_loss is not None:
                    imitation_loss = self.imitation_loss(values, chosen, is_expert, level, self.margin)
                    loss = loss + self.imitation_weight * imitation_loss
                    logs[f"imitation_loss_{level}"].append(imitation_loss.detach())
            # The values of the last level are the targets.
            errors = (current_q_values - target_q_values).detach().abs()
            self.replay_buffer.update_priorities(replay_data.indices, errors)

            # Optimize the policy
            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_value_(self.q_net.parameters(), self.max_grad_value)
            self.policy.optimizer.step()

            # Update target networks
            if (self._n_updates + gradient_step) % self.target_update_interval == 0:
                polyak_update(self.q_net.parameters(), self.q_net_target.parameters(), self.tau)

            logs["loss"].append(loss.detach())
            # Mean Q-value separately for expert and online steps
            logs["value_expert"].append(current_q_values.detach()[replay_data.is_expert])
            logs["value_online"].append(current_q_values.detach()[~replay_data.is_expert])

        self._log_updates(gradient_steps, logs)

    def _next_values(self, next_observations: PyTorchObs) -> th.Tensor:
        """Return the target network's value of its best action at its last level, (batch, 1)."""
        assert isinstance(next_observations, dict)
        return self.q_net_target.greedy(next_observations)[1][:, None]

    def _on_step(self) -> None:
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        assert isinstance(self._last_obs, dict)
        greedy, _ = self.predict(self._last_obs)
        scaled = self.as_policy_actions(greedy)
        probability = 1.0 if self.num_timesteps < learning_starts else self.exploration_rate
        if probability > 0:
            # Random actions have the same primitives.
            indices, places = self.codec.encode(scaled), self.codec.places(scaled)
            heights, generator = self._last_obs[self.q_net.scene_view.image_key], self.exploration_generator
            indices = explore_on_grid(indices, heights[:, 0], probability, self.codec.shape, generator)
            scaled = self.codec.decode(indices, places)
        return self.policy.unscale_action(scaled), scaled

    def _action_transform(self) -> ActionTransform:
        assert isinstance(self.action_space, spaces.Box)
        return partial(snap_to_grid, space=self.action_space, codec=self.codec)

    def as_policy_actions(self, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Convert actions to the policy's units and move them to the grid."""
        return self.codec.snap(super().as_policy_actions(actions))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "q_net", "q_net_target", "codec"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []


class SDQfD(SpatialDQN):
    """
    Strict deep Q-learning from demonstrations, see :class:`SpatialDQN` for the parameters.

    It imitates with :func:`~sb3_extensions.spatial_dqn.losses.strict_margin`.
    """

    imitation_loss = staticmethod(strict_margin)


class DQfD(SpatialDQN):
    """
    Deep Q-learning from demonstrations, see :class:`SpatialDQN` for the parameters.

    It imitates with :func:`~sb3_extensions.spatial_dqn.losses.large_margin`.
    """

    imitation_loss = staticmethod(large_margin)


class ADET(SpatialDQN):
    """
    Accelerated DQN with expert trajectories (Lakshminarayanan, Ozair and Bengio, "Reinforcement Learning with
    Few Expert Demonstrations", 2016), see :class:`SpatialDQN` for the parameters.

    It imitates with :func:`~sb3_extensions.spatial_dqn.losses.cross_entropy`.
    """

    default_imitation_weight: ClassVar[float] = 0.01
    imitation_loss = staticmethod(cross_entropy)
