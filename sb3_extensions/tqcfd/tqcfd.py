"""Truncated quantile critics from demonstrations."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any, ClassVar

import torch as th
from sb3_contrib.common.utils import quantile_huber_loss
from sb3_contrib.tqc.policies import Critic
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_extensions.common.augmentation import AugmentationSpec
from sb3_extensions.demonstrations.collecting import EpisodeData
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd.policies import EquivariantPolicy, MultiInputPolicy, StatePolicy


class TQCfD(SACfD):
    """
    Truncated quantile critics from demonstrations (TQCfD).

    :class:`~sb3_extensions.sacfd.SACfD` with the critics of sb3-contrib's TQC: what makes
    that SAC makes this TQC.

    TQC: https://arxiv.org/abs/2005.04269

    All parameters that are not listed are those of :class:`~sb3_extensions.sacfd.SACfD`.

    :param policy: The policy model to use (one of the aliases, or a class)
    :param env: The environment to learn from (if registered in Gym, can be str); its observations are a Dict
    :param top_quantiles_to_drop_per_net: number of quantiles to drop per network, of its ``n_quantiles`` (in
        ``policy_kwargs``, 25 by default)
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if no quantiles are left
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "EquivariantPolicy": EquivariantPolicy,
        "StatePolicy": StatePolicy,
    }
    critic: Critic  # type: ignore[assignment]

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
        top_quantiles_to_drop_per_net: int = 2,
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
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            bc_weight=bc_weight,
            bc_limit=bc_limit,
            self_imitation=self_imitation,
            q_weight=q_weight,
            expert_q_weight=expert_q_weight,
            backup_entropy=backup_entropy,
            value_range=value_range,
            actor_tau=actor_tau,
            exploration=exploration,
            greedy_fraction=greedy_fraction,
            expert_episodes=expert_episodes,
            expert_noise=expert_noise,
            expert_data=expert_data,
            dagger=dagger,
            augmentation=augmentation,
            pretrain_steps=pretrain_steps,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.top_quantiles_to_drop_per_net = top_quantiles_to_drop_per_net

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        if not 0 <= self.top_quantiles_to_drop_per_net < self.critic.n_quantiles:
            raise ValueError(
                f"top_quantiles_to_drop_per_net must be at least 0 and less than n_quantiles="
                f"{self.critic.n_quantiles}, got {self.top_quantiles_to_drop_per_net}"
            )

    def _estimates(self, critic: Any, features: th.Tensor, actions: th.Tensor) -> Any:
        """Quantiles of all heads, (batch, heads, quantiles)."""
        return th.stack(super()._estimates(critic, features, actions), dim=1)

    def _target_values(self, estimates: Any) -> th.Tensor:
        # Sort the quantiles of all critics and drop the top ones, to control overestimation
        quantiles = estimates.flatten(1).sort(dim=1).values
        dropped = self.top_quantiles_to_drop_per_net * self.critic.n_critics
        kept: th.Tensor = quantiles[:, : self.critic.quantiles_total - dropped]
        return kept

    def _critic_loss(
        self, estimates: Any, targets: th.Tensor, weights: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        # One loss for each transition: the function wants a batch, here of one
        losses = th.vmap(partial(quantile_huber_loss, sum_over_quantiles=False))(
            estimates[:, None], targets[:, None, None]
        )
        td_errors = (estimates.detach().mean(dim=2) - targets.mean(dim=1, keepdim=True)).abs()
        return (weights * losses[:, None]).mean(), td_errors.mean(dim=1, keepdim=True)

    def _means(self, estimates: Any) -> th.Tensor:
        return self._values(estimates)

    def _values(self, estimates: Any) -> th.Tensor:
        # Mean over the quantiles of all critics
        values: th.Tensor = estimates.mean(dim=2).mean(dim=1, keepdim=True)
        return values
