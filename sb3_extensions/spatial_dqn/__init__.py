"""Deep Q-learning over spatial action maps, from demonstrations."""

from sb3_extensions.spatial_dqn.policies import (
    ASRPolicy as ASRPolicy,
    EquivariantASRPolicy as EquivariantASRPolicy,
    EquivariantFCNPolicy as EquivariantFCNPolicy,
    FCNPolicy as FCNPolicy,
    RotFCNPolicy as RotFCNPolicy,
)
from sb3_extensions.spatial_dqn.spatial_dqn import (
    ADET as ADET,
    DQfD as DQfD,
    SDQfD as SDQfD,
    SpatialDQN as SpatialDQN,
)
