"""Actions of spatial Q networks: places on a grid, and the Box actions that they stand for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

Actions = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]

DEFAULT_SEQUENCE = "pxyr"
PIXEL = ("row", "column")
ANGLES = ("theta", "phi", "psi")
NAMES = ("x", "y", "theta", "z", "phi", "psi")
# The paper's grid, appendix "Benchmark Details": 16 yaws over half a turn; heights from 2 to 20 cm, tilts up
# to 30 degrees.
NUM_ROTATIONS = 16
NUM_HEIGHTS, HEIGHTS = 36, (0.02, 0.20)
NUM_TILTS, TILT = 7, math.pi / 6.0


class SpatialActionCodec:
    """
    Between actions in a policy's units, [-1, 1], and indices of pixel, yaw, height and tilt.

    An action has the indices ``(row, column, theta, z, phi, psi)``, as many as its sequence has. The middle
    of pixel (i, j) of the heightmap is at x = (2 i + 1) / size - 1, y = (2 j + 1) / size - 1. A gripper
    turned by half a turn is the same, with its tilts the other way round: yaws are taken modulo pi. What lies
    between two places of the grid goes to the nearest.

    :param size: side of the heightmap, pixels
    :param action_sequence: one character for each number of an action: p the primitive (-1 picks, 1 places),
        x and y, z, up to three r's (theta, phi, psi: about z, y, x)
    :param num_rotations: number of yaws, multiples of pi / num_rotations
    :param num_heights: number of heights
    :param heights: least and greatest height, m
    :param num_tilts: number of tilts about each of y and x
    :param tilt: greatest tilt, rad
    :param workspace_size: side of what the heightmap shows, m
    :param z_bounds: heights, m, that -1 and 1 stand for in an action
    :param theta_bounds: yaws, rad, that -1 and 1 stand for
    :param tilt_bound: tilt, rad, that 1 stands for, as -1 for the opposite
    :raises ValueError: if the sequence lacks x or y or has another character, a number is not positive, or
        the grid leaves the bounds
    """

    def __init__(
        self,
        size: int,
        action_sequence: str = DEFAULT_SEQUENCE,
        num_rotations: int = NUM_ROTATIONS,
        num_heights: int = NUM_HEIGHTS,
        heights: tuple[float, float] = HEIGHTS,
        num_tilts: int = NUM_TILTS,
        tilt: float = TILT,
        workspace_size: float = 0.4,
        z_bounds: tuple[float, float] = (0.0, 0.3),
        theta_bounds: tuple[float, float] = (0.0, math.pi),
        tilt_bound: float = math.pi / 4.0,
    ) -> None:
        for name, number in {
            "size": size,
            "num_rotations": num_rotations,
            "num_heights": num_heights,
            "num_tilts": num_tilts,
            "workspace_size": workspace_size,
        }.items():
            if number <= 0:
                raise ValueError(f"{name} must be positive, got {number}")
        if not z_bounds[0] <= heights[0] <= heights[1] <= z_bounds[1]:
            raise ValueError(f"heights must lie within z_bounds={z_bounds}, in order, got {heights}")
        if not 0 <= tilt <= tilt_bound:
            raise ValueError(f"tilt must be from 0 to tilt_bound={tilt_bound}, got {tilt}")
        self._parameters = {
            "size": size,
            "action_sequence": action_sequence,
            "num_rotations": num_rotations,
            "heights": [*heights, num_heights],
            "tilts": [tilt, num_tilts],
            "bounds": [workspace_size, *z_bounds, *theta_bounds, tilt_bound],
        }
        self.size = size
        self.action_sequence = action_sequence
        self.numbers = _numbers(action_sequence)
        self.workspace_size = workspace_size
        self.theta_bounds = theta_bounds
        tilts = np.linspace(-tilt, tilt, num_tilts) if num_tilts > 1 else np.zeros(1)
        grids = {
            "theta": np.arange(num_rotations) * math.pi / num_rotations,
            "z": np.linspace(*heights, num_heights),
            "phi": tilts,
            "psi": tilts,
        }
        bounds = {"z": z_bounds, "theta": theta_bounds, "phi": (-tilt_bound, tilt_bound)}
        self._bounds = {**bounds, "psi": bounds["phi"]}
        # Of each yaw: by how many half turns an action's differs from it, to be within the bounds
        low, high = theta_bounds
        outside = (grids["theta"] < low) | (grids["theta"] > high)
        self._half_turns = np.where(outside, np.ceil((low - grids["theta"]) / math.pi), 0.0)
        if (grids["theta"] + self._half_turns * math.pi > high).any():
            raise ValueError(
                f"theta_bounds must span the {num_rotations} yaws of half a turn, got {theta_bounds}"
            )
        self.grids = {name: grids[name] for name in NAMES if name in self.numbers and name in grids}
        """Values of each index behind the pixel's, m or rad, in order."""
        self._tables = self._make_tables()

    def describe(self) -> dict[str, Any]:
        """What the grid is made of, in JSON's types."""
        return self._parameters

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each index."""
        return (self.size, self.size, *map(len, self.grids.values()))

    @property
    def resolution(self) -> float:
        """Side of a pixel, m."""
        return self.workspace_size / self.size

    def encode(self, actions: npt.NDArray[np.floating]) -> Indices:
        """
        The nearest places on the grid.

        :param actions: in [-1, 1], (n, numbers of an action)
        :return: (n, indices)
        """
        values = dict(zip(self.numbers, np.asarray(actions, dtype=np.float64).T, strict=True))
        shares = [(values[name] + 1.0) / 2.0 for name in ("x", "y")]
        columns = [np.floor(share * self.size).clip(0, self.size - 1) for share in shares]
        flipped = np.zeros(len(actions), dtype=bool)
        for name, grid in self.grids.items():
            value = self._physical(name, values[name])
            if name == "theta":
                turns, index = np.divmod(np.rint(value * len(grid) / math.pi), len(grid))
                flipped = turns % 2 != 0
            else:
                value = np.where(flipped, -value, value) if name in ANGLES else value
                index = np.abs(value[:, None] - grid).argmin(axis=1)
            columns.append(index)
        return np.stack(columns, axis=1).astype(np.int64)

    def decode(self, indices: Indices, places: npt.NDArray[np.bool_]) -> Actions:
        """
        Return the actions of indices.

        :param indices: (n, indices)
        :param places: True to place, False to pick, (n,)
        :return: in [-1, 1], (n, numbers of an action)
        """
        actions: Actions = self.decode_tensor(th.as_tensor(indices), th.as_tensor(places)).numpy()
        return actions

    def decode_tensor(self, indices: th.Tensor, places: th.Tensor) -> th.Tensor:
        """
        Return the actions of indices. This method can be exported with the network.

        :param indices: int64, (n, indices)
        :param places: True to place, False to pick, bool (n,)
        :return: in [-1, 1], float32, (n, numbers of an action)
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
        turned = {"theta": self._half_turns * math.pi}
        tables = {"x": (2 * np.arange(self.size) + 1) / self.size - 1.0}
        for name, grid in self.grids.items():
            low, high = self._bounds[name]
            tables[name] = 2.0 * (grid + turned.get(name, 0.0) - low) / (high - low) - 1.0
        tables["tilt_sign"] = np.where(self._half_turns % 2 != 0, -1.0, 1.0)
        return {name: th.tensor(table, dtype=th.float32) for name, table in tables.items()}

    def snap(self, actions: npt.NDArray[np.floating]) -> Actions:
        """
        The nearest actions on the grid, with the primitives that they have.

        :param actions: in [-1, 1], (n, numbers of an action)
        :return: the same shape
        """
        return self.decode(self.encode(actions), self.places(actions))

    def places(self, actions: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
        """
        Whether actions place; where they do not say it, no.

        :param actions: in [-1, 1], (n, numbers of an action)
        :return: (n,)
        """
        if "p" not in self.numbers:
            return np.zeros(len(actions), dtype=bool)
        places: npt.NDArray[np.bool_] = np.asarray(actions)[:, self.numbers.index("p")] >= 0.0
        return places

    def _physical(self, name: str, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        low, high = self._bounds[name]
        return low + (values + 1.0) / 2.0 * (high - low)


def _numbers(sequence: str) -> tuple[str, ...]:
    """What each number of an action is."""
    angles: Iterator[str] = iter(ANGLES)
    if sequence.count("r") > len(ANGLES) or len(set(sequence) - {"r"}) != len(sequence.replace("r", "")):
        raise ValueError(
            f"action_sequence must name p, x, y, z once and r up to three times, got {sequence!r}"
        )
    if not {"x", "y"} <= set(sequence) <= set("pxyzr"):
        raise ValueError(f"action_sequence must have x and y, and may have p, z and r, got {sequence!r}")
    return tuple(next(angles) if character == "r" else character for character in sequence)
