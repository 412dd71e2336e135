"""Policies of TQCfD: the policies of SACfD with critics whose heads return quantiles."""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_extensions.sacfd import policies as sacfd
from sb3_extensions.sacfd.actor_critic import EquivariantCritic, MultiHeadCritic


class QuantileCritic(MultiHeadCritic):
    """
    Critic whose heads return quantiles. It has the attributes of :class:`sb3_contrib.tqc.policies.Critic`.

    :param n_quantiles: number of quantiles of each head
    :param kwargs: keyword arguments of :class:`~sb3_extensions.sacfd.actor_critic.MultiHeadCritic`
    """

    def __init__(self, n_quantiles: int = 25, **kwargs: Any) -> None:
        super().__init__(n_outputs=n_quantiles, **kwargs)
        self.n_quantiles = n_quantiles
        self.quantiles_total = n_quantiles * self.n_critics

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """Return quantiles of shape (batch, heads, quantiles)."""
        return th.stack(super().forward(obs, actions), dim=1)  # type: ignore[arg-type]


class EquivariantQuantileCritic(QuantileCritic, EquivariantCritic):
    """
    Critic whose quantiles are invariant to a rotation of images and (x, y) of the action.

    It has the parameters of both base classes.
    """


class QuantilePolicy(SACPolicy):
    """
    Policy whose critic returns quantiles.

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
    """
    CNN policy with a critic of quantiles. Actor and critic have one encoder each.

    It has the parameters of the base classes.
    """

    critic_class: ClassVar[type[MultiHeadCritic]] = QuantileCritic


class StatePolicy(QuantilePolicy, sacfd.StatePolicy):
    """
    Fully connected policy for observations without images, with a critic of quantiles.

    It has the parameters of the base classes.
    """

    critic_class: ClassVar[type[MultiHeadCritic]] = QuantileCritic


class EquivariantPolicy(QuantilePolicy, sacfd.EquivariantPolicy):
    """
    Equivariant policy with a critic of quantiles. Actor and critic have one encoder each.

    It has the parameters of the base classes.
    """

    critic_class: ClassVar[type[EquivariantCritic]] = EquivariantQuantileCritic
