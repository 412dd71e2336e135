"""Truncated quantile critics from demonstrations."""

from sb3_extensions.tqcfd.policies import EquivariantPolicy, MultiInputPolicy, StatePolicy
from sb3_extensions.tqcfd.tqcfd import TQCfD

__all__ = ["EquivariantPolicy", "MultiInputPolicy", "StatePolicy", "TQCfD"]
