"""Demonstrations of experts: collection, files, replay and exports (paper, Expert Demonstrations)."""

from bulletarm_gym.demonstrations.collecting import (
    RecordDemonstrations as RecordDemonstrations,
    collect as collect,
)
from bulletarm_gym.demonstrations.episodes import (
    Demonstrations as Demonstrations,
    Episode as Episode,
    ReplayError as ReplayError,
    load as load,
    replay as replay,
)
from bulletarm_gym.demonstrations.exports import (
    export_lerobot as export_lerobot,
    export_minari as export_minari,
)
from bulletarm_gym.demonstrations.rlds import export_rlds as export_rlds
from bulletarm_gym.demonstrations.robomimic import export_robomimic as export_robomimic
