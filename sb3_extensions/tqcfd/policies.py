"""Policies of SACfD with critics of quantiles, for TQCfD."""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_extensions.sacfd import policies as sacfd
from sb3_extensions.sacfd.actor_critic import EquivariantCritic, MultiHeadCritic


class QuantileCritic(MultiHeadCritic):
    """
    Critic of quantiles; its attributes are those of :class:`sb3_contrib.tqc.policies.Critic`.

    :param n_quantiles: of each head
    :param kwargs: keyword arguments of :class:`~sb3_extensions.sacfd.actor_critic.MultiHeadCritic`
    """

    def __init__(self, n_quantiles: int = 25, **kwargs: Any) -> None:
        super().__init__(n_outputs=n_quantiles, **kwargs)
        self.n_quantiles = n_quantiles
        self.quantiles_total = n_quantiles * self.n_critics

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """:return: (batch, heads, quantiles)"""
        return th.stack(super().forward(obs, actions), dim=1)  # type: ignore[arg-type]


class EquivariantQuantileCritic(QuantileCritic, EquivariantCritic):
    """
    Critic of quantiles that stay when images and (x, y) of the action turn together.

    The parameters are those of both.
    """


class QuantilePolicy(SACPolicy):
    """
    Policy whose critic gives quantiles.

    :param args: arguments of the policy
    :param n_quantiles: number of quantiles of each head of the critic
    :param kwargs: keyword arguments of the policy
    """

    def __init__(self, *args: Any, n_quantiles: int = 25, **kwargs: Any) -> None:
        self.n_quantiles = n_quantiles
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic_kwargs["n_quantiles"] = self.n_quantiles
        super()._build(lr_schedule)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(n_quantiles=self.n_quantiles)
        return data


class MultiInputPolicy(QuantilePolicy, sacfd.MultiInputPolicy):
    """CNN policy with a critic of quantiles: one encoder for the actor, one for the critic.

    The parameters are those of :class:`QuantilePolicy` and of
    :class:`sb3_extensions.sacfd.policies.MultiInputPolicy`.
    """

    critic_class: ClassVar[type[MultiHeadCritic]] = QuantileCritic


class StatePolicy(QuantilePolicy, sacfd.StatePolicy):
    """Fully connected policy for numbers alone, with a critic of quantiles.

    The parameters are those of :class:`QuantilePolicy` and of
    :class:`sb3_extensions.sacfd.policies.StatePolicy`.
    """

    critic_class: ClassVar[type[MultiHeadCritic]] = QuantileCritic


class EquivariantPolicy(QuantilePolicy, sacfd.EquivariantPolicy):
    """Equivariant policy with a critic of quantiles: one encoder for the actor, one for the critic.

    The parameters are those of :class:`QuantilePolicy` and of
    :class:`sb3_extensions.sacfd.policies.EquivariantPolicy`.
    """

    critic_class: ClassVar[type[EquivariantCritic]] = EquivariantQuantileCritic
