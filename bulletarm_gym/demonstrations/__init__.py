"""Demonstrations of the experts, collected, kept in files and handed on (paper, Expert Demonstrations)."""

from bulletarm_gym.demonstrations.collecting import check_planner, collect
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, load
from bulletarm_gym.demonstrations.exporting import export_minari
from bulletarm_gym.demonstrations.recording import RecordDemonstrations

__all__ = [
    "Demonstrations",
    "Episode",
    "RecordDemonstrations",
    "check_planner",
    "collect",
    "export_minari",
    "load",
]
