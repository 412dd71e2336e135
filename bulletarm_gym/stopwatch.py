"""Where an environment's time goes."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

PHYSICS = "physics"
"""The engine's simulation steps."""
RENDERING = "rendering"
"""Heightmaps, those that the expert looks at, too."""


class Stopwatch:
    """Adds up the seconds that parts of an environment take.

    :meth:`~bulletarm_gym.env.ManipulationEnv.measure` returns one that runs.
    """

    def __init__(self) -> None:
        self.seconds = {PHYSICS: 0.0, RENDERING: 0.0}
        """Of each part so far."""

    def timed(self, part: str, function: Callable[..., Any]) -> "partial[Any]":
        """Return a function that does the same and adds its time to a part."""
        return partial(self._run, part, function)

    def _run(self, part: str, function: Callable[..., Any], *args: Any, **options: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **options)
        finally:
            self.seconds[part] += time.perf_counter() - start
