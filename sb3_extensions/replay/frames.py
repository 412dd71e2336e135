"""Storage of observations for replay: each once, images quantised, in a ring behind pinned ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_extensions.common.images import IMAGE_AXES
from sb3_extensions.replay.quantisation import Quantiser

Ids = npt.NDArray[np.int64]


class PinnedRing:
    """
    Numbering of items kept in a fixed number of slots: pinned items first, never overwritten, and a ring of
    the latest others behind them. Every item has an id, counted from 0 in the order of arrival and never used
    again.

    :param capacity: number of slots
    :param min_ring: number of slots that pinned items must leave to the ring
    """

    def __init__(self, capacity: int, min_ring: int) -> None:
        self.capacity = capacity
        self.min_ring = min_ring
        self.pinned = 0
        self.first = 0  # id of the oldest item in the ring that is still kept
        self.end = 0  # id that the next item gets

    def __len__(self) -> int:
        return self.pinned + self.end - self.first

    @property
    def used_slots(self) -> int:
        """Number of slots that have ever been filled; they are the first ones."""
        return min(self.end, self.capacity)

    def has_room(self, count: int) -> bool:
        """
        Ask whether items can be pinned.

        :param count: number of items
        :return: whether enough slots are left to others
        """
        return self.pinned + count <= self.capacity - self.min_ring

    def pin(self, count: int) -> Ids:
        """
        Take slots for items that are never overwritten.

        :param count: number of items
        :return: their ids, shape (count,)
        :raises ValueError: if the ring has items already, or if it would become too short
        """
        if self.end > self.pinned:
            raise ValueError("items can be pinned only before the first other one arrives")
        if not self.has_room(count):
            raise ValueError(
                f"{self.pinned + count} pinned items do not fit into {self.capacity} slots, "
                f"of which {self.min_ring} must be left for others"
            )
        self.pinned += count
        self.first = self.end = self.pinned
        return np.arange(self.pinned - count, self.pinned)

    def append(self, count: int) -> Ids:
        """
        Take slots in the ring, those of the oldest items where it is full.

        :param count: number of items, at most the length of the ring
        :return: their ids, shape (count,)
        """
        self.end += count
        self.first = max(self.first, self.end - (self.capacity - self.pinned))
        return np.arange(self.end - count, self.end)

    def slots(self, ids: Ids) -> Ids:
        """
        Where the items are.

        :param ids: ids of kept items, any shape
        :return: slots from 0 to ``capacity - 1``, same shape
        """
        ring = self.pinned + (ids - self.pinned) % (self.capacity - self.pinned)
        return np.where(ids < self.pinned, ids, ring)

    def ids(self, ranks: Ids) -> Ids:
        """
        Ids of the kept items by age.

        :param ranks: numbers from 0 (oldest, pinned ones before the ring's) to ``len(self) - 1``, any shape
        :return: ids, same shape
        """
        return np.where(ranks < self.pinned, ranks, ranks - self.pinned + self.first)

    def ids_in(self, slots: Ids) -> Ids:
        """
        Ids of the latest items in given slots.

        :param slots: slots that have been filled, any shape
        :return: ids, same shape
        """
        latest = self.end - 1
        ring = latest - (latest - slots) % (self.capacity - self.pinned)
        return np.where(slots < self.pinned, slots, ring)


class FrameStore:
    """
    Observations, each a dictionary of arrays. Floating-point images (boxes with three axes and finite bounds)
    are kept as integers over their bounds, everything else in the type of its space (float64 as float32).

    Nothing is allocated before :meth:`allocate`.

    :param boxes: Box space of each part of an observation
    :param capacity: number of observations
    :param min_ring: number of places that pinned observations must leave to others
    :param dtype: type of quantised images, ``"uint8"`` or ``"uint16"``
    :raises ValueError: if a space is something else
    """

    def __init__(
        self,
        boxes: dict[str, spaces.Space[Any]],
        capacity: int,
        min_ring: int,
        dtype: npt.DTypeLike = "uint8",
    ) -> None:
        self.ring = PinnedRing(capacity, min_ring)
        self.data: dict[str, npt.NDArray[Any]] = {}
        self._quantisers: dict[str, Quantiser] = {}
        self._layout: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {}
        for key, space in boxes.items():
            if not isinstance(space, spaces.Box):
                raise ValueError(f"observations must be of Box spaces, {key!r} is of {space}")
            self._add_key(key, space, np.dtype(dtype))

    def _add_key(self, key: str, space: spaces.Box, image_dtype: np.dtype[Any]) -> None:
        stored = np.dtype(np.float32) if space.dtype == np.float64 else np.dtype(space.dtype)
        is_float = np.issubdtype(stored, np.floating)
        if is_float and len(space.shape) == IMAGE_AXES and space.is_bounded():
            self._quantisers[key] = Quantiser(space, image_dtype)
            stored = image_dtype
        self._layout[key] = (space.shape, stored)

    @property
    def keys(self) -> set[str]:
        """Keys of the observations."""
        return set(self._layout)

    @property
    def image_dtype(self) -> str | None:
        """Type of quantised images, None if there are none."""
        return next((quantiser.dtype.name for quantiser in self._quantisers.values()), None)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each part of an observation."""
        return {key: shape for key, (shape, _) in self._layout.items()}

    @property
    def nbytes(self) -> int:
        """Size of the whole store in bytes, allocated or not."""
        frame = sum(int(np.prod(shape)) * dtype.itemsize for shape, dtype in self._layout.values())
        return frame * self.ring.capacity

    def allocate(self) -> None:
        """Allocate the arrays, each of shape (capacity, *shape of the key)."""
        for key, (shape, dtype) in self._layout.items():
            self.data[key] = np.zeros((self.ring.capacity, *shape), dtype=dtype)

    def pin(self, observations: dict[str, npt.NDArray[Any]]) -> Ids:
        """
        Store observations that are never overwritten.

        :param observations: for each key an array of shape (n, *shape of the key)
        :return: ids, shape (n,)
        """
        return self._write(self.ring.pin(_length(observations)), observations)

    def append(self, observations: dict[str, npt.NDArray[Any]]) -> Ids:
        """
        Store observations over the oldest ones.

        :param observations: for each key an array of shape (n, *shape of the key)
        :return: ids, shape (n,)
        """
        return self._write(self.ring.append(_length(observations)), observations)

    def _write(self, ids: Ids, observations: dict[str, npt.NDArray[Any]]) -> Ids:
        slots = self.ring.slots(ids)
        for key, array in self.data.items():
            values = np.asarray(observations[key])
            if values.shape[1:] != array.shape[1:]:
                raise ValueError(
                    f"{key!r} must be observations of shape {array.shape[1:]}, got {values.shape[1:]}"
                )
            array[slots] = self._quantisers[key].encode(values) if key in self._quantisers else values
        return ids

    def read(self, ids: Ids) -> dict[str, npt.NDArray[Any]]:
        """
        Observations as they were stored, up to half a quantisation step.

        :param ids: ids of kept observations, shape (n,)
        :return: for each key a new array of shape (n, *shape of the key), float32 where it was floating point
        """
        slots = self.ring.slots(ids)
        values = {key: array[slots] for key, array in self.data.items()}
        return {key: self._decode(key, value) for key, value in values.items()}

    def _decode(self, key: str, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return self._quantisers[key].decode(values) if key in self._quantisers else values

    def clear(self) -> None:
        """Forget all observations."""
        self.ring = PinnedRing(self.ring.capacity, self.ring.min_ring)

    def __getstate__(self) -> dict[str, Any]:
        # Only slots that were ever filled go into a pickle.
        state = self.__dict__.copy()
        state["data"] = {key: array[: self.ring.used_slots] for key, array in self.data.items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        used = state.pop("data")
        self.__dict__.update(state, data={})
        if used:
            self.allocate()
            for key, array in used.items():
                self.data[key][: len(array)] = array


def _length(observations: dict[str, npt.NDArray[Any]]) -> int:
    return len(next(iter(observations.values())))
