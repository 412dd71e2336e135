"""Algorithms by name: ours, Stable-Baselines3's and sb3-contrib's."""

import functools
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any

ALGORITHMS = {
    "adet": "sb3_extensions.spatial_dqn.ADET",
    "dqfd": "sb3_extensions.spatial_dqn.DQfD",
    "ferm": "sb3_extensions.ferm.FERM",
    "sacfd": "sb3_extensions.sacfd.SACfD",
    "sdqfd": "sb3_extensions.spatial_dqn.SDQfD",
    "spatial_dqn": "sb3_extensions.spatial_dqn.SpatialDQN",
    "tqcfd": "sb3_extensions.tqcfd.TQCfD",
}
"""Import paths of our algorithms, so that listing their names does not import PyTorch."""
OTHERS = {
    "a2c": "stable_baselines3.A2C",
    "ars": "sb3_contrib.ARS",
    "crossq": "sb3_contrib.CrossQ",
    "ddpg": "stable_baselines3.DDPG",
    "dqn": "stable_baselines3.DQN",
    "ppo": "stable_baselines3.PPO",
    "ppo_lstm": "sb3_contrib.RecurrentPPO",
    "qrdqn": "sb3_contrib.QRDQN",
    "sac": "stable_baselines3.SAC",
    "td3": "stable_baselines3.TD3",
    "tqc": "sb3_contrib.TQC",
    "trpo": "sb3_contrib.TRPO",
}
"""Import paths of the other algorithms, with rl_zoo3's names."""


def callable_from_path(path: str) -> Callable[..., Any]:
    """Import a class or function from ``package.module.name``; raise ``ImportError`` if it is neither."""
    found: Callable[..., Any] = pkgutil.resolve_name(path)
    if not callable(found):
        raise ImportError(f"{path} is not a class or a function")
    return found


def class_from_path(path: str) -> type[Any]:
    """Import a class from ``package.module.Class``; raise ``ImportError`` if it is not a class."""
    found = callable_from_path(path)
    if not isinstance(found, type):
        raise ImportError(f"{path} is not a class")
    return found


@functools.cache
def algorithm_classes() -> Mapping[str, type[Any]]:
    """Import all algorithms and return their classes by name."""
    return {name: class_from_path(path) for name, path in {**ALGORITHMS, **OTHERS}.items()}
