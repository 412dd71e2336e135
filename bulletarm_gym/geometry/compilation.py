"""Compilation of numeric loops by Numba, without fastmath and threads, so that results are reproducible."""

import logging
import os
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba import njit
from numba.core import event

P = ParamSpec("P")
R = TypeVar("R")

LOGGER = logging.getLogger("bulletarm_gym")
CONFIG: Any = numba.config


class CompileMonitor(event.Listener):
    """Counter of the functions of :func:`compiled` that Numba compiles; cached functions do not count.

    A line is logged before the first compilation.
    """

    def __init__(self) -> None:
        self.count = 0
        self.functions: list[Any] = []
        """Functions of :func:`compiled`."""

    def on_start(self, event: Any) -> None:
        """Count a function that is about to be compiled."""
        function = event.data["dispatcher"]
        if function not in self.functions:
            return
        if not self.count:
            folder = function.stats.cache_path
            where = f"once and stores the code in {folder}" if folder else "in every process"
            LOGGER.warning("bulletarm_gym compiles its numeric loops (up to a minute) %s", where)
        self.count += 1

    def on_end(self, event: Any) -> None:
        """Do nothing."""


MONITOR = CompileMonitor()
"""Monitor of this process."""
event.register("numba:compile", MONITOR)  # type: ignore[no-untyped-call]


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function compiled at its first call; the code is cached on disk.

    If Numba finds no writable cache folder, the cache is in the folder of temporary files.
    """
    try:
        return _cached(function)
    except RuntimeError:  # neither the package's folder nor the user's cache folder is writable
        CONFIG.CACHE_DIR = str(_temporary_folder())
    message = "The cache folder of Numba is not writable. Using %s. Set NUMBA_CACHE_DIR to another folder."
    LOGGER.warning(message, CONFIG.CACHE_DIR)
    return _cached(function)


def _cached(function: Callable[P, R]) -> Callable[P, R]:
    found: Callable[P, R] = njit(cache=True, error_model="numpy")(function)
    MONITOR.functions.append(found)
    return found


def _temporary_folder() -> Path:
    """Return a temporary folder that no other user can write to, because cached code is executed."""
    user = getattr(os, "getuid", lambda: 0)()
    folder = Path(tempfile.gettempdir()) / f"bulletarm-gym-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    private = not folder.is_symlink() and not status.st_mode & 0o077 and status.st_uid == user
    return folder if private or os.name == "nt" else Path(tempfile.mkdtemp(prefix="bulletarm-gym-"))


SENSORS = ["heightmap", "color", "segmentation", "holding"]
EPISODES: list[dict[str, Any]] = [
    {"task": "picking:BlockPicking", "control": "close_loop", "view": "point_cloud"},
    {
        "task": "pushing:BlockPushing",
        "control": "close_loop",
        "observation": SENSORS,
        "randomization": "real",
    },
    {"task": "clutter:ObjectGrasping", "control": "close_loop", "object_set": ["cube"] * 5},
    {"task": "stacking:BlockStacking", "control": "open_loop"},
    {"task": "stacking:BlockStacking", "control": "open_loop", "surface": "ramp"},
]
"""Arguments of environments that together call every compiled function."""


def warm_up(make: Callable[..., Any]) -> None:
    """Run one short episode of each environment, once, if this process has compiled a function.

    :param make: constructor of an environment
    """
    while MONITOR.count and EPISODES:
        parameters = EPISODES.pop()
        task = f"bulletarm_gym.tasks.{parameters['task']}"
        with closing(make(**{**parameters, "task": task, "obs_size": 32})) as env:
            env.reset(seed=0)
            for _ in range(4):  # two picks and places
                *_, terminated, truncated, _ = env.step(env.expert_action())
                if terminated or truncated:
                    break
