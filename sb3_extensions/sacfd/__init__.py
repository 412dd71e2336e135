"""Soft actor-critic from demonstrations."""

from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy, StatePolicy
from sb3_extensions.sacfd.sacfd import SACfD

__all__ = ["EquivariantPolicy", "MultiInputPolicy", "SACfD", "StatePolicy"]
