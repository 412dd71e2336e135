"""Demonstrations of the experts, collected, kept in files and handed on (paper, Expert Demonstrations)."""

from bulletarm_gym.demonstrations.collecting import check_planner, collect
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, load
from bulletarm_gym.demonstrations.exporting import export_minari
from bulletarm_gym.demonstrations.lerobot_format import export_lerobot
from bulletarm_gym.demonstrations.recording import RecordDemonstrations
from bulletarm_gym.demonstrations.replaying import ReplayError, replay

__all__ = [
    "Demonstrations",
    "Episode",
    "RecordDemonstrations",
    "ReplayError",
    "check_planner",
    "collect",
    "export_lerobot",
    "export_minari",
    "load",
    "replay",
]
