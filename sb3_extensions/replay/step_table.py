"""Storage of the replay buffer: one row for each step, in rings after pinned rows."""

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_extensions.common.observations import IMAGE_AXES
from sb3_extensions.replay.quantisation import Quantiser

Rows = npt.NDArray[np.int64]
Observations = dict[str, npt.NDArray[Any]]
Layout = dict[str, tuple[tuple[int, ...], npt.DTypeLike]]
"""Shape and type of each column."""

MIN_RING = 3
"""Rows that each environment needs: a step, the last observation of its episode, and the next step."""


class StepTable:
    """
    Table with one row for each step. An episode of n steps has n + 1 rows; the last row holds its last
    observation only.

    The pinned rows come first and are never overwritten. The other rows are divided into one ring for each
    environment. A row is valid if it holds a step and the next row holds the observation that followed.

    Floating-point images with finite bounds are stored as integers, float64 as float32, other types
    unchanged. The arrays are allocated when they are first used.

    :param capacity: number of rows
    :param n_envs: number of environments
    :param observation_spaces: Box space of each entry of the observations
    :param columns: shape and type of every other column
    :param image_dtype: type of quantised images, ``"uint8"`` or ``"uint16"``, None to store them unchanged
    :raises ValueError: if an observation space is not a Box
    """

    def __init__(
        self,
        capacity: int,
        n_envs: int,
        observation_spaces: dict[str, spaces.Space[Any]],
        columns: Layout,
        image_dtype: str | None = "uint8",
    ) -> None:
        self.capacity, self.n_envs = capacity, n_envs
        self.quantisers: dict[str, Quantiser] = {}
        self.observation_layout: Layout = {}
        for key, space in observation_spaces.items():
            if not isinstance(space, spaces.Box):
                raise ValueError(f"observation_space must have Box spaces only, got {space} for {key!r}")
            dtype = np.dtype(np.float32) if space.dtype == np.float64 else np.dtype(space.dtype)
            is_image = np.issubdtype(dtype, np.floating) and len(space.shape) == IMAGE_AXES
            if image_dtype is not None and is_image and space.is_bounded():
                self.quantisers[key] = Quantiser(space, image_dtype)
                dtype = self.quantisers[key].dtype
            self.observation_layout[key] = (space.shape, dtype)
        self.column_layout: Layout = {**columns, "valid": ((), np.bool_)}
        self.clear()

    @cached_property
    def observations(self) -> Observations:
        """Stored form of the observations, for each key an array of ``capacity`` rows."""
        return self._allocate(self.observation_layout)

    @cached_property
    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """All other columns, arrays of ``capacity`` rows."""
        return self._allocate(self.column_layout)

    def _allocate(self, layout: Layout) -> dict[str, npt.NDArray[Any]]:
        return {name: np.zeros((self.capacity, *shape), dtype) for name, (shape, dtype) in layout.items()}

    def clear(self) -> None:
        """Remove all rows."""
        self.n_pinned = 0
        self.heads = np.arange(self.n_envs) * self.ring_length
        self.columns["valid"].fill(False)

    @property
    def ring_length(self) -> int:
        """Number of rows of each environment."""
        return (self.capacity - self.n_pinned) // self.n_envs

    @property
    def nbytes(self) -> int:
        """Size of the full table in bytes."""
        layout = [*self.observation_layout.values(), *self.column_layout.values()]
        return self.capacity * sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype in layout)

    def pin(self, n_rows: int) -> Rows:
        """Return ``n_rows`` consecutive new rows that are never overwritten."""
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
        """Write n observations to n rows. The rows are invalid until their steps are written."""
        for key, array in self.observations.items():
            quantiser = self.quantisers.get(key)
            values = observations[key]
            array[rows] = values if quantiser is None else quantiser.encode(values)
        self.columns["valid"][rows] = False

    def write_steps(self, rows: Rows, **columns: Any) -> None:
        """Write the other columns of rows and make the rows valid."""
        for name, values in columns.items():
            self.columns[name][rows] = values
        self.columns["valid"][rows] = True

    def read_observations(self, rows: Rows) -> Observations:
        """Return the observations of rows. The error of images is at most half a quantisation step."""
        observations = {key: array[rows] for key, array in self.observations.items()}
        return observations | {
            key: quantiser.decode(observations[key]) for key, quantiser in self.quantisers.items()
        }

    def __getstate__(self) -> dict[str, Any]:
        # A pickle holds only rows of valid steps and of their next observations.
        valid = np.flatnonzero(self.columns["valid"])
        used = np.unique(np.concatenate([valid, self.next(valid), self.heads]))
        state = {**self.__dict__, "used": used}
        for name in ("observations", "columns"):
            state[name] = {key: array[used] for key, array in getattr(self, name).items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        used, observations, columns = (state.pop(name) for name in ("used", "observations", "columns"))
        self.__dict__.update(state)
        for arrays, stored in ((self.observations, observations), (self.columns, columns)):
            for name, values in stored.items():
                arrays[name][used] = values
