"""Policies of TQCfD: the policies of SACfD with critics whose heads return quantiles."""

from typing import Any

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_extensions.sacfd import policies as sacfd


class QuantilePolicy(SACPolicy):
    """
    Policy whose critic returns quantiles.

    :param args: arguments of the policy of SACfD with the same name
    :param n_quantiles: number of quantiles of each head of the critic
    :param kwargs: keyword arguments of the policy of SACfD with the same name
    """

    def __init__(self, *args: Any, n_quantiles: int = 25, **kwargs: Any) -> None:
        self.n_quantiles = n_quantiles
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic_kwargs["n_outputs"] = self.n_quantiles
        super()._build(lr_schedule)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(n_quantiles=self.n_quantiles)
        return data


class MultiInputPolicy(QuantilePolicy, sacfd.MultiInputPolicy):
    """CNN policy with a critic of quantiles, see :class:`QuantilePolicy` for the parameters."""


class StatePolicy(QuantilePolicy, sacfd.StatePolicy):
    """Fully connected policy with a critic of quantiles, see :class:`QuantilePolicy` for the parameters."""


class EquivariantPolicy(QuantilePolicy, sacfd.EquivariantPolicy):
    """Equivariant policy with a critic of quantiles, see :class:`QuantilePolicy` for the parameters."""
