"""Truncated quantile critics from demonstrations."""

from sb3_extensions.tqcfd.policies import (
    EquivariantPolicy as EquivariantPolicy,
    MultiInputPolicy as MultiInputPolicy,
    StatePolicy as StatePolicy,
)
from sb3_extensions.tqcfd.tqcfd import TQCfD as TQCfD
