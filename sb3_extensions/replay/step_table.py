"""Storage of replay: one row a step, in rings behind pinned rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_extensions.common.images import IMAGE_AXES
from sb3_extensions.replay.quantisation import Quantiser

Rows = npt.NDArray[np.int64]
Observations = dict[str, npt.NDArray[Any]]

MIN_RING = 3
"""Rows that each environment needs: a step, the last observation of its episode, and the next step."""


class ObservationColumn:
    """
    Type and coding of one entry of the observations.

    Floating-point images with finite bounds are stored as integers, float64 as float32, everything else as it
    is.

    :param space: Box space of the entry
    :param image_dtype: type of quantised images, ``"uint8"`` or ``"uint16"``
    """

    def __init__(self, space: spaces.Box, image_dtype: str) -> None:
        self.shape = space.shape
        self.dtype = np.dtype(np.float32) if space.dtype == np.float64 else np.dtype(space.dtype)
        self.quantiser: Quantiser | None = None
        if np.issubdtype(self.dtype, np.floating) and len(space.shape) == IMAGE_AXES and space.is_bounded():
            self.quantiser = Quantiser(space, image_dtype)
            self.dtype = self.quantiser.dtype

    def encode(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the stored form of observations."""
        return values if self.quantiser is None else self.quantiser.encode(values)

    def decode(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return observations from their stored form."""
        return values if self.quantiser is None else self.quantiser.decode(values)


class StepTable:
    """
    Table with one row a step. An episode of n steps has n + 1 rows; the last one holds its last observation
    only.

    The pinned rows come first and are never overwritten. The other rows are divided into one ring an
    environment. In an episode the row after row i is ``next(i)``. A row is valid if it holds a step and
    ``next(i)`` holds the observation that followed.

    The arrays are allocated at the first write.

    :param capacity: number of rows
    :param n_envs: number of environments
    :param observation_spaces: Box space of each entry of the observations
    :param columns: shape and type of every other column
    :param image_dtype: type of quantised images, ``"uint8"`` or ``"uint16"``
    :raises ValueError: if an observation space is not a Box
    """

    def __init__(
        self,
        capacity: int,
        n_envs: int,
        observation_spaces: dict[str, spaces.Space[Any]],
        columns: dict[str, tuple[tuple[int, ...], npt.DTypeLike]],
        image_dtype: str = "uint8",
    ) -> None:
        self.capacity, self.n_envs = capacity, n_envs
        self.codings: dict[str, ObservationColumn] = {}
        for key, space in observation_spaces.items():
            if not isinstance(space, spaces.Box):
                raise ValueError(f"observation_space must have Box spaces only, got {space} for {key!r}")
            self.codings[key] = ObservationColumn(space, image_dtype)
        self._layout: dict[str, tuple[tuple[int, ...], npt.DTypeLike]] = {**columns, "valid": ((), np.bool_)}
        self.observations: Observations = {}
        self.columns: dict[str, npt.NDArray[Any]] = {}
        self.clear()

    def clear(self) -> None:
        """Remove all rows."""
        self.n_pinned = 0
        self.heads = np.arange(self.n_envs) * self.ring_length
        if self.columns:
            self.columns["valid"].fill(False)

    @property
    def ring_length(self) -> int:
        """Number of rows of each environment."""
        return (self.capacity - self.n_pinned) // self.n_envs

    @property
    def nbytes(self) -> int:
        """Size of the full table in bytes, allocated or not."""
        codings = [(coding.shape, coding.dtype) for coding in self.codings.values()]
        layout = [*codings, *self._layout.values()]
        return self.capacity * sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype in layout)

    @property
    def is_allocated(self) -> bool:
        """Whether the arrays exist."""
        return bool(self.columns)

    def allocate(self) -> None:
        """Allocate the arrays."""
        self.observations = {
            key: np.zeros((self.capacity, *coding.shape), coding.dtype)
            for key, coding in self.codings.items()
        }
        self.columns = {
            name: np.zeros((self.capacity, *shape), dtype) for name, (shape, dtype) in self._layout.items()
        }

    def pin(self, n_rows: int) -> Rows:
        """
        Reserve rows that are never overwritten.

        :param n_rows: number of rows
        :return: consecutive rows
        """
        self.n_pinned += n_rows
        self.heads = self.n_pinned + np.arange(self.n_envs) * self.ring_length
        return np.arange(self.n_pinned - n_rows, self.n_pinned)

    def next(self, rows: Rows) -> Rows:
        """Return the row after each row, within its ring."""
        following = rows + 1
        length = self.ring_length
        wraps = (rows >= self.n_pinned) & ((following - self.n_pinned) % length == 0)
        return np.where(wraps, following - length, following)

    def write_observations(self, rows: Rows, observations: Observations) -> None:
        """
        Write observations; the rows are invalid until their steps are written.

        :param rows: shape (n,)
        :param observations: for each key an array of shape (n, *shape of the key)
        :raises ValueError: if a shape differs from that of the space
        """
        for key, array in self.observations.items():
            values = np.asarray(observations[key])
            if values.shape[1:] != array.shape[1:]:
                raise ValueError(
                    f"observations[{key!r}] must have shape {array.shape[1:]}, got {values.shape[1:]}"
                )
            array[rows] = self.codings[key].encode(values)
        self.columns["valid"][rows] = False

    def write_steps(self, rows: Rows, **columns: Any) -> None:
        """Write the other columns of rows and make the rows valid."""
        for name, values in columns.items():
            self.columns[name][rows] = values
        self.columns["valid"][rows] = True

    def read_observations(self, rows: Rows) -> Observations:
        """
        Return observations, images with an error of at most half a quantisation step.

        :param rows: shape (n,)
        :return: for each key an array of shape (n, *shape of the key)
        """
        return {key: self.codings[key].decode(array[rows]) for key, array in self.observations.items()}

    def __getstate__(self) -> dict[str, Any]:
        # Rows that were never written stay out of a pickle.
        state = self.__dict__.copy()
        used = self._used_rows()
        state["used"] = used
        state["observations"] = {key: array[used] for key, array in self.observations.items()}
        state["columns"] = {name: array[used] for name, array in self.columns.items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        used, observations, columns = (state.pop(name) for name in ("used", "observations", "columns"))
        self.__dict__.update(state, observations={}, columns={})
        if columns:
            self.allocate()
            for arrays, saved in ((self.observations, observations), (self.columns, columns)):
                for name, array in saved.items():
                    arrays[name][used] = array

    def _used_rows(self) -> Rows:
        """Return the rows that valid steps and their next observations occupy."""
        if not self.columns:
            return np.empty(0, dtype=np.int64)
        valid = np.flatnonzero(self.columns["valid"])
        return np.unique(np.concatenate([valid, self.next(valid), self.heads]))
