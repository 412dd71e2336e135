"""Compiling numeric loops, in one way everywhere: without fastmath and threads, so results are exact."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile at the first call, kept on disk between processes where any cache folder can be written."""
    try:
        cached: Callable[P, R] = njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba found neither the package's folder nor the user's to be writable
        cached = njit(error_model="numpy")(function)
    return cached
