"""Deep Q-learning over spatial action maps, from demonstrations."""

from sb3_extensions.spatial_dqn.policies import (
    ASRPolicy,
    EquivariantASRPolicy,
    EquivariantFCNPolicy,
    FCNPolicy,
    RotFCNPolicy,
)
from sb3_extensions.spatial_dqn.spatial_dqn import ADET, DQfD, SDQfD, SpatialDQN

__all__ = [
    "ADET",
    "ASRPolicy",
    "DQfD",
    "EquivariantASRPolicy",
    "EquivariantFCNPolicy",
    "FCNPolicy",
    "RotFCNPolicy",
    "SDQfD",
    "SpatialDQN",
]
