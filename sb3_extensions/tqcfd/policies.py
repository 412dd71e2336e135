"""Policies of TQCfD for images and numbers: the paper's CNN and its equivariant network."""

from __future__ import annotations

from sb3_contrib.tqc.policies import Critic, TQCPolicy

from sb3_extensions.common.policies import CnnNetworks, EquivariantNetworks, InvariantHeads

# To the type checker the mixed-in classes are SAC's: those of TQC have the same attributes, of other classes.


class MultiInputPolicy(CnnNetworks, TQCPolicy):  # type: ignore[misc]
    """CNN policy with a critic of quantiles: one encoder for the actor, one for the critic.

    The parameters are those of :class:`~sb3_extensions.common.policies.CnnNetworks` and of
    :class:`sb3_contrib.tqc.policies.TQCPolicy`.
    """


class EquivariantQuantileCritic(InvariantHeads, Critic):  # type: ignore[misc]
    """Critic whose values stay when images and (x, y) of the action turn together."""


class EquivariantPolicy(EquivariantNetworks, TQCPolicy):  # type: ignore[misc]
    """Equivariant policy with a critic of quantiles: one encoder for the actor, one for the critic.

    The parameters are those of :class:`~sb3_extensions.common.policies.EquivariantNetworks` and of
    :class:`sb3_contrib.tqc.policies.TQCPolicy`.
    """

    critic_class = EquivariantQuantileCritic
