"""Conversion between Box actions and indices on the action grid of spatial Q networks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.common.components import check_integer, check_positive

Actions = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]

DEFAULT_SEQUENCE = "pxyr"
EXPLORED_HEIGHT = 0.01
"""Minimum height (m) of pixels with objects to pick (the authors' code)."""
PIXEL = ("row", "column")
ANGLES = ("theta", "phi", "psi")
INDEX_ORDER = ("theta", "z", "phi", "psi")
"""Order of the indices after the pixel."""


@dataclass(eq=False)
class SpatialActionCodec:
    """
    Conversion between normalised actions, [-1, 1], and indices of pixel, yaw, height and tilts.

    The indices are ``(row, column, theta, z, phi, psi)``, or fewer if the action sequence lacks numbers. The
    centre of pixel (i, j) of the heightmap is x = (2 i + 1) / size - 1, y = (2 j + 1) / size - 1. A rotation
    of the gripper by pi with inverted tilts is the same pose, so yaws are modulo pi. The default grid is
    that of the authors' code.

    :param size: side of the heightmap, pixels
    :param action_sequence: one character for each number of an action: p primitive (-1 pick, 1 place), x and
        y, z, and one or three r (theta, phi, psi: rotations about z, y, x)
    :param num_rotations: number of yaws, multiples of pi / num_rotations
    :param num_heights: number of heights
    :param heights: minimum and maximum height, m
    :param num_tilts: number of tilts about each of y and x
    :param tilt: maximum tilt, rad
    :param workspace_size: side of the area of the heightmap, m
    :param z_bounds: heights of the actions -1 and 1, m
    :param theta_bounds: yaws of the actions -1 and 1, rad
    :param tilt_bound: tilt of the action 1, rad; the action -1 is the opposite
    :raises ValueError: if the sequence has no x and y, a number is not positive, or a value is out of bounds
    """

    size: int
    action_sequence: str = DEFAULT_SEQUENCE
    num_rotations: int = 16
    num_heights: int = 36
    heights: tuple[float, float] = (0.02, 0.20)
    num_tilts: int = 7
    tilt: float = math.pi / 8.0
    workspace_size: float = 0.4
    z_bounds: tuple[float, float] = (0.0, 0.3)
    theta_bounds: tuple[float, float] = (0.0, math.pi)
    tilt_bound: float = math.pi / 4.0

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("size", "num_rotations", "num_heights", "num_tilts")}
        check_integer(1, **counts)
        check_positive(workspace_size=self.workspace_size)
        (low, high), z_bounds, tilt = self.heights, self.z_bounds, self.tilt
        if not z_bounds[0] <= low <= high <= z_bounds[1]:
            raise ValueError(f"heights must be within z_bounds={z_bounds}, in order, got {self.heights}")
        if not 0 <= tilt <= self.tilt_bound:
            raise ValueError(f"tilt must be from 0 to tilt_bound={self.tilt_bound}, got {tilt}")
        if "x" not in ActionSequence(self.action_sequence, len(self.action_sequence)):
            raise ValueError(f"action_sequence must contain x and y, got {self.action_sequence!r}")
        angles = iter(ANGLES)
        self.numbers = tuple(next(angles) if name == "r" else name for name in self.action_sequence)
        tilts = np.linspace(-tilt, tilt, self.num_tilts) if self.num_tilts > 1 else np.zeros(1)
        yaws = np.arange(self.num_rotations) * math.pi / self.num_rotations
        heights, tilt_bounds = np.linspace(low, high, self.num_heights), (-self.tilt_bound, self.tilt_bound)
        grids = {"theta": yaws, "z": heights, "phi": tilts, "psi": tilts}
        self._bounds = {"z": z_bounds, "theta": self.theta_bounds, "phi": tilt_bounds, "psi": tilt_bounds}
        # Number of rotations by pi that move each yaw into the bounds.
        low, high = self.theta_bounds
        outside = (yaws < low) | (yaws > high)
        self._half_turns = np.where(outside, np.ceil((low - yaws) / math.pi), 0.0)
        if (yaws + self._half_turns * math.pi > high).any():
            raise ValueError(
                f"theta_bounds must contain {len(yaws)} yaws of a range of pi, got {self.theta_bounds}"
            )
        self.grids = {name: grids[name] for name in INDEX_ORDER if name in self.numbers}
        """Values of each index after the pixel, m or rad."""
        self.shape = (self.size, self.size, *map(len, self.grids.values()))
        """Number of values of each index."""
        self.resolution = self.workspace_size / self.size
        """Side of a pixel, m."""
        self._tables = self._make_tables()

    def encode(self, actions: npt.NDArray[np.floating]) -> Indices:
        """Return the nearest grid points (n, indices) of actions in [-1, 1], (n, numbers of an action)."""
        values = dict(zip(self.numbers, np.asarray(actions, dtype=np.float64).T, strict=True))
        fractions = [(values[name] + 1.0) / 2.0 for name in ("x", "y")]
        columns = [np.floor(fraction * self.size).clip(0, self.size - 1) for fraction in fractions]
        flipped = np.zeros(len(actions), dtype=bool)
        for name, grid in self.grids.items():
            low, high = self._bounds[name]
            value = low + (values[name] + 1.0) / 2.0 * (high - low)
            if name == "theta":
                half_turns, index = np.divmod(np.rint(value * len(grid) / math.pi), len(grid))
                flipped = half_turns % 2 != 0
            else:
                value = np.where(flipped, -value, value) if name in ANGLES else value
                index = np.abs(value[:, None] - grid).argmin(axis=1)
            columns.append(index)
        return np.stack(columns, axis=1).astype(np.int64)

    def decode(self, indices: Indices, places: npt.NDArray[np.bool_]) -> Actions:
        """Return the actions of indices as arrays, see :meth:`decode_tensor`."""
        actions: Actions = self.decode_tensor(th.as_tensor(indices), th.as_tensor(places)).numpy()
        return actions

    def decode_tensor(self, indices: th.Tensor, places: th.Tensor) -> th.Tensor:
        """
        Return the actions of indices, in [-1, 1], float32, (n, numbers of an action).

        :param indices: int64, (n, indices)
        :param places: True to place, False to pick, bool (n,)
        """
        columns = dict(zip((*PIXEL, *self.grids), indices.unbind(1), strict=True))
        values = {"p": th.where(places, 1.0, -1.0), "x": self._lookup("x", columns["row"])}
        values["y"] = self._lookup("x", columns["column"])
        values |= {name: self._lookup(name, columns[name]) for name in self.grids}
        if "theta" in self.grids:
            sign = self._lookup("tilt_sign", columns["theta"])
            values |= {name: values[name] * sign for name in ANGLES[1:] if name in values}
        return th.stack([values[name].float() for name in self.numbers], dim=1)

    def _lookup(self, name: str, indices: th.Tensor) -> th.Tensor:
        return self._tables[name].to(indices.device)[indices]

    def _make_tables(self) -> dict[str, th.Tensor]:
        """Return the numbers of an action in [-1, 1] by index, and the sign of tilts by yaw."""
        offsets = {"theta": self._half_turns * math.pi}
        tables = {"x": (2 * np.arange(self.size) + 1) / self.size - 1.0}
        for name, grid in self.grids.items():
            low, high = self._bounds[name]
            tables[name] = 2.0 * (grid + offsets.get(name, 0.0) - low) / (high - low) - 1.0
        tables["tilt_sign"] = np.where(self._half_turns % 2 != 0, -1.0, 1.0)
        return {name: th.tensor(table, dtype=th.float32) for name, table in tables.items()}

    def snap(self, actions: npt.NDArray[np.floating]) -> Actions:
        """Return the nearest actions on the grid with the same primitives, in [-1, 1]."""
        return self.decode(self.encode(actions), self.places(actions))

    def places(self, actions: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
        """Return whether each action is a place, (n,). Without p in the sequence all are picks."""
        if "p" not in self.numbers:
            return np.zeros(len(actions), dtype=bool)
        places: npt.NDArray[np.bool_] = np.asarray(actions)[:, self.numbers.index("p")] >= 0.0
        return places


def snap_to_grid(
    action: npt.NDArray[Any], rng: np.random.Generator, space: spaces.Box, codec: SpatialActionCodec
) -> npt.NDArray[Any]:
    """Move an action, in the units of a bounded space, to the nearest cell of the grid."""
    # float64, so that the action of a cell is exact in a space from -1 to 1
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    snapped = codec.snap(2.0 * ((np.clip(action, low, high) - low) / (high - low))[None] - 1.0)[0]
    executed: npt.NDArray[Any] = low + (snapped.astype(np.float64) + 1.0) / 2.0 * (high - low)
    return executed.clip(low, high).astype(space.dtype)


def explore_on_grid(
    indices: Indices,
    heights: npt.NDArray[Any],
    probability: float,
    shape: Sequence[int],
    generator: th.Generator,
) -> Indices:
    """
    Replace some actions on a grid by random ones.

    The pixel is sampled from the pixels higher than :data:`EXPLORED_HEIGHT`, if the image has any.

    :param indices: row, column and further indices, (n, indices)
    :param heights: heightmaps in m, (n, size, size)
    :param probability: probability that an action is replaced
    :param shape: number of values of each index
    :param generator: random generator on the CPU
    """
    replaced = th.rand(len(indices), generator=generator) < probability
    sampled = th.stack([th.randint(count, (len(indices),), generator=generator) for count in shape], dim=1)
    shares = th.rand(len(indices), generator=generator, dtype=th.float64).numpy()
    for index, (image, share) in enumerate(zip(heights, shares, strict=True)):
        high = np.argwhere(image > EXPLORED_HEIGHT)
        if len(high):
            sampled[index, :2] = th.from_numpy(high[int(share * len(high))])
    return np.where(replaced[:, None], sampled, indices)
