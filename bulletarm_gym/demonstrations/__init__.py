"""Demonstrations of experts: collection, files, replay and exports (paper, Expert Demonstrations)."""

from bulletarm_gym.demonstrations.collecting import RecordDemonstrations, collect
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, ReplayError, load, replay
from bulletarm_gym.demonstrations.exports import export_lerobot, export_minari
from bulletarm_gym.demonstrations.rlds import export_rlds
from bulletarm_gym.demonstrations.robomimic import export_robomimic

__all__ = [
    "Demonstrations",
    "Episode",
    "RecordDemonstrations",
    "ReplayError",
    "collect",
    "export_lerobot",
    "export_minari",
    "export_rlds",
    "export_robomimic",
    "load",
    "replay",
]
