"""Soft actor-critic from demonstrations."""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.sac.sac import SAC

from sb3_extensions.common.from_demonstrations import FromDemonstrations
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy


class SACfD(FromDemonstrations, SAC):
    """
    Soft actor-critic from demonstrations (SACfD).

    SAC whose replay buffer begins with the episodes of an expert, and whose actor imitates the expert. With
    ``bc_weight=0`` and ``expert_episodes=0`` it is SAC, with an ``augmentation`` it is RAD or DrQ SACfD.

    Paper: https://arxiv.org/abs/2205.14292 (BulletArm, Section "Close-Loop 4D Benchmark"); the defaults are
    its parameters. SAC: https://arxiv.org/abs/1801.01290

    The parameters are those of :class:`~sb3_extensions.common.from_demonstrations.FromDemonstrations`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "EquivariantPolicy": EquivariantPolicy,
    }

    def _target_values(self, estimates: Any) -> th.Tensor:
        return self._values(estimates)

    def _critic_loss(
        self, estimates: Any, targets: th.Tensor, weights: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        td_errors = [q_values - targets for q_values in estimates]
        loss = 0.5 * th.stack([(weights * error.pow(2)).mean() for error in td_errors]).sum()
        return loss, th.stack(td_errors).detach().abs().mean(dim=0)

    def _values(self, estimates: Any) -> th.Tensor:
        # Min over all critic networks
        return th.cat(estimates, dim=1).min(dim=1, keepdim=True).values
