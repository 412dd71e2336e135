"""Quantisation of images for the replay buffer. Networks apply the same rounding when acting."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces

DTYPES = ("uint8", "uint16")
MAX_FLOAT32_ERROR = 0.25
"""Maximum error of float32 arithmetic, in quantisation steps, for which rounding returns the right level."""


class Quantiser:
    """
    Uniform levels from the lowest to the highest bound of a Box.

    ``encode(decode(levels))`` returns the same levels. :meth:`round_trip` equals ``decode(encode(values))``
    bit for bit, because both use the same sequence of float32 operations.

    :param space: Box with finite bounds
    :param dtype: ``"uint8"`` (256 levels) or ``"uint16"`` (65,536 levels)
    :raises ValueError: if the bounds are infinite or equal, if their range is too narrow for float32, or for
        another ``dtype``
    """

    def __init__(self, space: spaces.Box, dtype: str = "uint8") -> None:
        if dtype not in DTYPES:
            raise ValueError(f"dtype must be one of {DTYPES}, got {dtype!r}")
        low, high = float(space.low.min()), float(space.high.max())
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"space must have finite bounds with low < high, got {space}")
        self.dtype = np.dtype(dtype)
        self.levels = int(np.iinfo(self.dtype).max)
        step = (high - low) / self.levels
        if max(abs(low), abs(high)) * np.finfo(np.float32).eps > MAX_FLOAT32_ERROR * step:
            raise ValueError(f"the range of {space} is too narrow for {self.levels + 1} levels in float32")
        self._low, self._high = np.float32(low), np.float32(high)
        self._step, self._inverse_step = np.float32(step), np.float32(1.0 / step)

    def encode(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.unsignedinteger]:
        """
        Round values to the nearest levels, halves to even. Values outside the bounds are clipped.

        :param values: any shape, in the units of the space
        :return: levels of the type ``dtype``, same shape
        """
        levels = (np.asarray(values, dtype=np.float32) - self._low) * self._inverse_step
        encoded: npt.NDArray[np.unsignedinteger] = np.clip(np.rint(levels), 0, self.levels).astype(self.dtype)
        return encoded

    def decode(self, levels: npt.NDArray[np.unsignedinteger]) -> npt.NDArray[np.float32]:
        """
        Return the values of levels.

        :param levels: any shape
        :return: values within the bounds, same shape
        """
        values = levels.astype(np.float32)
        decoded: npt.NDArray[np.float32] = np.minimum(values * self._step + self._low, self._high)
        return decoded

    @th.no_grad()
    def round_trip(self, values: th.Tensor) -> th.Tensor:
        """
        Return the values that the replay buffer returns after storing them, without gradient.

        :param values: any shape, in the units of the space
        :return: float32 tensor of the same shape
        """
        rounded = self._levels_of(values).mul_(float(self._step)).add_(float(self._low))
        return rounded.clamp_(max=float(self._high))

    @th.no_grad()
    def normalise(self, values: th.Tensor) -> th.Tensor:
        """
        Return rounded values scaled to [0, 1], equal for a value and its stored copy, without gradient.

        :param values: any shape, in the units of the space
        :return: float32 tensor of the same shape
        """
        return self._levels_of(values).mul_(1.0 / self.levels)

    def _levels_of(self, values: th.Tensor) -> th.Tensor:
        offset = values.float() - float(self._low)
        return offset.mul_(float(self._inverse_step)).round_().clamp_(0, self.levels)
