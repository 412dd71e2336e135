"""Soft actor-critic from demonstrations."""

from sb3_extensions.sacfd.policies import (
    EquivariantPolicy as EquivariantPolicy,
    MultiInputPolicy as MultiInputPolicy,
    StatePolicy as StatePolicy,
)
from sb3_extensions.sacfd.sacfd import SACfD as SACfD
