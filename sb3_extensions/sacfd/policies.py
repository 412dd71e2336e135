"""Policies of SACfD for images and numbers: the paper's CNN and its equivariant network."""

from __future__ import annotations

from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import SACPolicy

from sb3_extensions.common.policies import CnnNetworks, EquivariantNetworks, InvariantHeads


class MultiInputPolicy(CnnNetworks, SACPolicy):
    """CNN policy of the paper: one encoder for the actor, one for all heads of the critic.

    The parameters are those of :class:`~sb3_extensions.common.policies.CnnNetworks` and of
    :class:`stable_baselines3.sac.policies.SACPolicy`.
    """


class EquivariantCritic(InvariantHeads, ContinuousCritic):
    """Critic whose values stay when images and (x, y) of the action turn together."""


class EquivariantPolicy(EquivariantNetworks, SACPolicy):
    """Equivariant policy of the paper: one encoder for the actor, one for all heads of the critic.

    The parameters are those of :class:`~sb3_extensions.common.policies.EquivariantNetworks` and of
    :class:`stable_baselines3.sac.policies.SACPolicy`.
    """

    critic_class = EquivariantCritic
