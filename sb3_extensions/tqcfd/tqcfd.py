"""Truncated quantile critics from demonstrations."""

from functools import partial
from typing import Any, ClassVar

import torch as th
from sb3_contrib.common.utils import quantile_huber_loss
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.sac.policies import SACPolicy

from sb3_extensions.common.components import check_integer
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd.policies import EquivariantPolicy, MultiInputPolicy, StatePolicy


class TQCfD(SACfD):
    """
    Truncated quantile critics from demonstrations (TQCfD): SACfD with the critics of sb3-contrib's TQC.

    TQC: https://arxiv.org/abs/2005.04269. See :class:`~sb3_extensions.sacfd.SACfD` for the other parameters.

    :param top_quantiles_to_drop_per_net: number of quantiles to drop per network, of its ``n_quantiles`` (in
        ``policy_kwargs``, 25 by default)
    :raises ValueError: if all quantiles of the policy's critic are dropped
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "EquivariantPolicy": EquivariantPolicy,
        "StatePolicy": StatePolicy,
    }

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        top_quantiles_to_drop_per_net: int = 2,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, _init_setup_model=False, **kwargs)
        self.top_quantiles_to_drop_per_net = top_quantiles_to_drop_per_net

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        dropped, critic = self.top_quantiles_to_drop_per_net, self.critic
        check_integer(0, top_quantiles_to_drop_per_net=dropped)
        # A critic of sb3-contrib, one of this package, or one of SAC
        n_quantiles = getattr(critic, "n_quantiles", getattr(critic, "n_outputs", 1))
        if dropped >= n_quantiles:
            raise ValueError(
                f"top_quantiles_to_drop_per_net must be less than the policy's n_quantiles={n_quantiles}, "
                f"got {dropped}"
            )

    def _q_values(self, critic: Any, features: th.Tensor, actions: th.Tensor) -> Any:
        """Return the quantiles of all heads, (batch, heads, quantiles)."""
        return th.stack(super()._q_values(critic, features, actions), dim=1)

    def _target_values(self, q_values: Any) -> th.Tensor:
        # Sort the quantiles of all critics and drop the top ones, to control overestimation
        quantiles = q_values.flatten(1).sort(dim=1).values
        dropped = self.top_quantiles_to_drop_per_net * q_values.shape[1]
        kept: th.Tensor = quantiles[:, : quantiles.shape[1] - dropped]
        return kept

    def _critic_loss(
        self, q_values: Any, targets: th.Tensor, weights: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        # vmap() gives one loss for each step, because the function reduces over the batch
        losses = th.vmap(partial(quantile_huber_loss, sum_over_quantiles=False))(
            q_values[:, None], targets[:, None, None]
        )
        td_errors = (q_values.detach().mean(dim=2) - targets.mean(dim=1, keepdim=True)).abs()
        return (weights * losses[:, None]).mean(), td_errors.mean(dim=1, keepdim=True)

    def _min_q(self, q_values: Any) -> th.Tensor:
        # Mean over the quantiles of all critics
        values: th.Tensor = q_values.mean(dim=2).mean(dim=1, keepdim=True)
        return values
