"""Compiling numeric loops, in one way everywhere: without fastmath and threads, so results are exact."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from numba import float64, njit
from numba.extending import intrinsic

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile at the first call, kept on disk between processes where any cache folder can be written."""
    try:
        cached: Callable[P, R] = njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba found neither the package's folder nor the user's to be writable
        cached = njit(error_model="numpy")(function)
    return cached


def _emit_fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    return float64(float64, float64, float64), lambda context, builder, signature, arguments: builder.fma(
        *arguments
    )


fma: Callable[[float, float, float], float] = intrinsic(_emit_fma)  # type: ignore[assignment]
"""``a * b + c``, rounded once, in compiled code: as the library under NumPy's ``@`` does it."""
