"""Quantisation of images for the replay buffer. Networks apply the same rounding when acting."""

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces

MAX_FLOAT32_ERROR = 0.25
"""Maximum error of float32 arithmetic, in quantisation steps, for which rounding returns the right level."""


class Quantiser:
    """
    Uniform levels over the bounds of a Box, the lowest level on ``low``, the highest on ``high``.

    ``encode(decode(levels))`` returns the same levels.

    :param space: Box with finite bounds, ``low < high`` everywhere
    :param dtype: ``"uint8"`` (256 levels) or ``"uint16"`` (65,536 levels)
    :raises ValueError: if the bounds are infinite or equal, if their range is too narrow or too wide for
        float32, or for another ``dtype``
    """

    def __init__(self, space: spaces.Box, dtype: str = "uint8") -> None:
        if dtype not in ("uint8", "uint16"):
            raise ValueError(f"dtype must be 'uint8' or 'uint16', got {dtype!r}")
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            width = (high - low).astype(np.float32)
        if not (np.isfinite(width) & (width > 0)).all():
            raise ValueError(
                "space must have finite bounds with low < high, at most the largest float32 apart, "
                f"got {space}. Use quantise=None."
            )
        self.dtype = np.dtype(dtype)
        self.levels = int(np.iinfo(self.dtype).max)
        step = (high - low) / self.levels
        if (np.maximum(abs(low), abs(high)) * np.finfo(np.float32).eps > MAX_FLOAT32_ERROR * step).any():
            raise ValueError(f"the range of {space} is too narrow for {self.levels + 1} levels in float32")
        self._low, self._high, self._step, self._inverse_step = (
            _as_tensor(bound) for bound in (low, high, step, 1.0 / step)
        )

    def encode(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.unsignedinteger]:
        """Return the nearest levels of values, halves to even. Values outside the bounds are clipped."""
        tensor = th.from_numpy(np.array(values, dtype=np.float32))
        levels: npt.NDArray[np.unsignedinteger] = self._to_levels(tensor).numpy().astype(self.dtype)
        return levels

    def decode(self, levels: npt.NDArray[np.unsignedinteger]) -> npt.NDArray[np.float32]:
        """Return the values of levels, within the bounds and of the same shape."""
        values: npt.NDArray[np.float32] = self._to_values(th.from_numpy(levels.astype(np.float32))).numpy()
        return values

    def round_trip(self, values: th.Tensor) -> th.Tensor:
        """Return ``decode(encode(values))`` as a float32 tensor without gradient."""
        return self._to_values(self._to_levels(values))

    def normalise(self, values: th.Tensor) -> th.Tensor:
        """Return rounded values scaled to [0, 1], equal for a value and its stored copy, without gradient."""
        return self._to_levels(values).mul_(1.0 / self.levels)

    @th.no_grad()
    def _to_levels(self, values: th.Tensor) -> th.Tensor:
        offset = values.float() - self._low.to(values.device)
        return offset.mul_(self._inverse_step.to(values.device)).round_().clamp_(0, self.levels)

    @th.no_grad()
    def _to_values(self, levels: th.Tensor) -> th.Tensor:
        low, high, step = (bound.to(levels.device) for bound in (self._low, self._high, self._step))
        return levels.mul_(step).add_(low).clamp_(max=high)


def _as_tensor(bound: npt.NDArray[np.float64]) -> th.Tensor:
    """Return a bound in float32, one number if all entries are equal."""
    tensor = th.from_numpy(bound.astype(np.float32))
    return tensor.flatten()[0].clone() if (tensor == tensor.flatten()[0]).all() else tensor
