"""Rounding of bounded float arrays to small unsigned integers, for replay memory.

The replay buffer stores images as integers; the features extractors apply the same rounding to what they see,
so that a policy acts on exactly what it was trained on.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces

DTYPES = ("uint8", "uint16")
# Largest error, in steps, that float32 arithmetic may add before rounding could leave the right level.
MAX_FLOAT32_ERROR = 0.25

FloatArray = npt.NDArray[np.float32]


class Quantiser:
    """Uniform levels over the bounds of a Box, the lowest level on ``low``, the highest on ``high``.

    ``encode(decode(q)) == q`` for every level, and :meth:`round_trip` equals ``decode(encode(x))`` bit for
    bit (both are the same sequence of float32 operations).

    :param space: box with finite bounds, ``low < high`` everywhere; equal bounds for all entries are kept as
        one number
    :param dtype: ``"uint8"`` (256 levels) or ``"uint16"`` (65536 levels), or the numpy type
    :raises ValueError: if the bounds are infinite, equal, or too narrow for their offset, or the dtype is
        another
    """

    def __init__(self, space: spaces.Box, dtype: npt.DTypeLike = "uint8") -> None:
        if not isinstance(dtype, str):
            dtype = np.dtype(dtype).name
        if dtype not in DTYPES:
            raise ValueError(f"dtype must be one of {DTYPES}, got {dtype!r}")
        self.dtype = np.dtype(dtype)
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise ValueError(f"quantisation needs finite bounds with low < high, got {space}")
        self.levels = int(np.iinfo(self.dtype).max)
        step = (high - low) / self.levels
        if (np.maximum(abs(low), abs(high)) * np.finfo(np.float32).eps > MAX_FLOAT32_ERROR * step).any():
            raise ValueError(f"the bounds of {space} are too narrow for {self.levels + 1} levels in float32")
        self._low, self._high = _collapse(low), _collapse(high)
        self._step, self._inverse_step = _collapse(step), _collapse(1.0 / step)

    def encode(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.unsignedinteger]:
        """Round to the nearest level, halves to even; values outside the bounds go to the nearest bound.

        :param values: array whose last axes have the shape of the space, in its units
        :return: levels, of ``dtype`` and the same shape
        """
        levels = (np.asarray(values, dtype=np.float32) - self._low) * self._inverse_step
        encoded: npt.NDArray[np.unsignedinteger] = np.clip(np.rint(levels), 0, self.levels).astype(self.dtype)
        return encoded

    def decode(self, levels: npt.NDArray[np.unsignedinteger]) -> FloatArray:
        """Value of each level.

        :param levels: array of levels, last axes of the shape of the space
        :return: float32 array of the same shape, within the bounds
        """
        values = levels.astype(np.float32)
        values = values * self._step + self._low
        return np.minimum(values, self._high)

    @th.no_grad()
    def round_trip(self, values: th.Tensor) -> th.Tensor:
        """What :meth:`decode` of :meth:`encode` gives, as a tensor; carries no gradient.

        :param values: tensor whose last axes have the shape of the space
        :return: float32 tensor of the same shape
        """
        rounded = self._levels_of(values).mul_(_like(self._step, values)).add_(_like(self._low, values))
        return rounded.clamp_(max=_like(self._high, values))

    @th.no_grad()
    def normalise(self, values: th.Tensor) -> th.Tensor:
        """Rounded values on [0, 1] over the bounds: the same for a value and for its stored copy; no
        gradient.

        :param values: tensor whose last axes have the shape of the space
        :return: float32 tensor of the same shape
        """
        return self._levels_of(values).mul_(1.0 / self.levels)

    def _levels_of(self, values: th.Tensor) -> th.Tensor:
        offset = values.float() - _like(self._low, values)
        return offset.mul_(_like(self._inverse_step, values)).round_().clamp_(0, self.levels)


def _collapse(bound: npt.NDArray[np.float64]) -> FloatArray:
    """One number if all entries are equal, in float32."""
    array = bound.astype(np.float32)
    return array.reshape(-1)[0:1].reshape(()) if array.size and (array == array.flat[0]).all() else array


def _like(bound: FloatArray, values: th.Tensor) -> th.Tensor:
    """The bound as a tensor where the values are."""
    return th.from_numpy(np.array(bound)).to(values.device)
