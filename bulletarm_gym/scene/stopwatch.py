"""Measurement of the time that parts of an environment take."""

import time
from collections.abc import Callable
from typing import Any

PHYSICS = "physics"
"""Name of the simulation steps."""
RENDERING = "rendering"
"""Name of the computation of heightmaps, including those for the expert."""


class Stopwatch:
    """Sums of the times of parts; :meth:`~bulletarm_gym.env.ManipulationEnv.measure` starts one."""

    def __init__(self) -> None:
        self.seconds = {PHYSICS: 0.0, RENDERING: 0.0}
        """Time (s) of each part so far."""

    def timed(self, part: str, function: Callable[..., Any]) -> Any:
        """Return a function that calls another one and adds the time to a part."""

        def run(*args: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                self.seconds[part] += time.perf_counter() - start

        return run
