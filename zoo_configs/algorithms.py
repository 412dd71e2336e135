"""The algorithms that the command line knows besides those of rl_zoo3."""

from __future__ import annotations

import importlib
from typing import Any

# Named by path, so that listing them does not load PyTorch.
ALGORITHMS = {
    "adet": "sb3_extensions.spatial_dqn.ADET",
    "dqfd": "sb3_extensions.spatial_dqn.DQfD",
    "ferm": "sb3_extensions.ferm.FERM",
    "sacfd": "sb3_extensions.sacfd.SACfD",
    "sdqfd": "sb3_extensions.spatial_dqn.SDQfD",
    "spatial_dqn": "sb3_extensions.spatial_dqn.SpatialDQN",
    "tqcfd": "sb3_extensions.tqcfd.TQCfD",
}


def class_from_path(path: str) -> type[Any]:
    """
    Import a class.

    :param path: Dotted path, ``package.module.Class``
    :return: The class
    :raises ImportError: if there is no such module, or no such class in it
    """
    module, _, name = path.rpartition(".")
    found = getattr(importlib.import_module(module), name, None)
    if not isinstance(found, type):
        raise ImportError(f"{module} has no class {name}")
    return found


def register_algorithms() -> dict[str, type[Any]]:
    """
    Make our algorithms known to rl_zoo3, whose modules share one table of algorithms.

    :return: That table, from name to class
    """
    from rl_zoo3.utils import ALGOS

    for name, path in ALGORITHMS.items():
        ALGOS.setdefault(name, class_from_path(path))
    return ALGOS
