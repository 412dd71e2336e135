"""Filters that commute with the rotations (and reflections) of a finite group.

A filter is a combination of steerable filters: Gaussian rings times circular harmonics, sampled on the pixel
grid (Weiler and Cesa, "General E(2)-equivariant steerable CNNs", 2019).
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import TypeAlias

import numpy as np
import torch as th
from scipy.linalg import block_diag
from torch import nn

from sb3_extensions.equivariant.groups import FieldType, Group, Matrices, Representation
from sb3_extensions.equivariant.harmonics import harmonic_basis

PROJECTOR_THRESHOLD = 0.5
"""Threshold between the eigenvalues 0 and 1 of a projector in float64."""
WHOLE_BASIS_LIMIT = 64
"""Maximum number of filters of a stored basis. For larger bases it is faster to rotate one column, and
storage would need 140 MB (C_32, 7 x 7 pixels)."""

Weights: TypeAlias = Mapping[str, th.Tensor] | nn.ParameterDict


class FilterSpace(nn.Module):
    """Space of the filters between two field types that commute with the group; has no parameters.

    A filter has one tensor of coefficients for each pair of an output and an input representation.

    :param in_type: input fields
    :param out_type: output fields
    :param kernel_size: side of the filter, pixels; 1 for a linear map of vectors
    :raises ValueError: if the groups differ, the side is below 1, or the space is empty
    """

    bias_basis: th.Tensor

    def __init__(self, in_type: FieldType, out_type: FieldType, kernel_size: int) -> None:
        super().__init__()
        if in_type.group != out_type.group:
            raise ValueError(f"in_type has the group {in_type.group}, out_type {out_type.group}")
        if kernel_size < 1:
            raise ValueError(f"kernel_size must be at least 1, got {kernel_size}")
        self.in_type, self.out_type, self.kernel_size = in_type, out_type, kernel_size
        self.shapes: dict[str, tuple[int, int, int]] = {}
        """Shape (out fields, in fields, basis) of the coefficients of each pair of representations."""
        self.bases = nn.ModuleDict()
        self._passed: dict[str, float] = {}
        for row, (out_rep, out_count) in enumerate(out_type.fields):
            for column, (in_rep, in_count) in enumerate(in_type.fields):
                basis = _make_basis(in_rep, out_rep, kernel_size)
                if basis is not None:
                    key = f"{row}_{column}"
                    self.bases[key], self._passed[key] = basis, basis.passed
                    self.shapes[key] = (out_count, in_count, basis.size)
        if not self.shapes:
            raise ValueError(f"no map from {in_type} to {out_type} commutes with the group")
        self.register_buffer("bias_basis", _invariants(out_type), persistent=False)
        self.num_biases = len(self.bias_basis)
        """Number of fields that can have a bias (regular, quotient, trivial)."""

    def std(self, key: str, gain: float) -> float:
        """Return the standard deviation of initial coefficients.

        This is He's rule for the stronger of two signals: white noise, and a signal that is constant over
        pixels and fields. Steerable filters are smooth and amplify constant signals more.

        :param key: pair of representations, see :attr:`shapes`
        :param gain: ``sqrt(2)`` (He) before a ReLU, 1 without ReLU
        """
        return gain / math.sqrt(self.in_type.size * self.kernel_size**2 * self._passed[key])

    def expand(self, weights: Weights) -> th.Tensor:
        """Return the filter of the equivalent plain convolution.

        :param weights: coefficients of each pair of representations, (..., out fields, in fields, basis)
        :return: (..., out channels, in channels, side, side)
        """
        columns = range(len(self.in_type.fields))
        rows = [
            [self._expand_block(weights, row, column) for column in columns]
            for row in range(len(self.out_type.fields))
        ]
        joined = [blocks[0] if len(blocks) == 1 else th.cat(blocks, dim=-3) for blocks in rows]
        return joined[0] if len(joined) == 1 else th.cat(joined, dim=-4)

    def _expand_block(self, weights: Weights, row: int, column: int) -> th.Tensor:
        """Return the filters between one input and one output representation."""
        (out_rep, out_count), (in_rep, in_count) = self.out_type.fields[row], self.in_type.fields[column]
        key, batch = f"{row}_{column}", next(iter(weights.values())).shape[:-3]
        shape = (*batch, out_count * out_rep.size, in_count * in_rep.size, self.kernel_size, self.kernel_size)
        if key not in self.shapes:
            return th.zeros(shape, device=self.bias_basis.device)
        blocks: th.Tensor = self.bases[key](weights[key])
        return blocks.reshape(shape)


class _Basis(nn.Module):
    """Basis of ``size`` filters between two fields.

    The sums of squares of all filters, and of their responses to a constant signal, are ``noise`` and
    ``constant``. A filter has ``plain_size`` entries.
    """

    def __init__(self, size: int, noise: float, constant: float, plain_size: int) -> None:
        super().__init__()
        self.size = size
        self.passed = max(noise, constant) / plain_size
        """Mean square after random filters relative to a plain filter, for the stronger of both signals."""


class _WholeBasis(_Basis):
    """Stored basis of any two representations, (basis, out size, in size, side, side)."""

    filters: th.Tensor

    def __init__(self, filters: Matrices) -> None:
        size, out_size, *_ = filters.shape
        noise, constant = np.square(filters).sum(), np.square(filters.sum(axis=(2, 3, 4))).sum()
        super().__init__(size, noise, constant, math.prod(filters.shape[1:]))
        flat = th.tensor(filters.reshape(size, out_size, -1), dtype=th.float32)
        self.register_buffer("filters", flat, persistent=False)

    def forward(self, weights: th.Tensor) -> th.Tensor:
        """:return: (..., out fields, out size, in fields, in size * side * side)"""
        # (out fields, in fields, basis) x (basis, out size, rest); the channels of a field stay adjacent.
        blocks = th.matmul(weights.flatten(0, -2), self.filters.flatten(1))
        return blocks.view(*weights.shape[:-1], *self.filters.shape[1:]).transpose(-3, -2)


class _ColumnBasis(_Basis):
    """Basis for regular inputs. The column of element g is the stored column rotated by g.

    :param actions: matrices of the output representation, (elements, out size, out size)
    :param waves: rotated harmonics, (elements, harmonics, side, side)
    """

    actions: th.Tensor
    waves: th.Tensor

    def __init__(self, actions: Matrices, waves: Matrices) -> None:
        (order, out_size, _), (_, harmonics, side, _) = actions.shape, waves.shape
        noise = out_size * np.square(waves).sum()
        constant = np.square(np.einsum("goq,gh->hqo", actions, waves.sum(axis=(2, 3)))).sum()
        super().__init__(harmonics * out_size, noise, constant, out_size * order * side**2)
        self.register_buffer("actions", th.tensor(actions, dtype=th.float32), persistent=False)
        flat = th.tensor(waves.reshape(order, harmonics, -1), dtype=th.float32)
        self.register_buffer("waves", flat, persistent=False)

    def forward(self, weights: th.Tensor) -> th.Tensor:
        """:return: (batch, out fields, out size, in fields, elements, pixels)"""
        (out_count, in_count, _), (order, out_size, _) = weights.shape[-3:], self.actions.shape
        # First the output channels, because there are fewer harmonics than pixels.
        columns = th.matmul(self.actions.flatten(0, 1), weights.reshape(-1, out_size).T)
        columns = th.bmm(columns.view(order, -1, self.waves.shape[1]), self.waves)
        blocks = columns.view(order, out_size, -1, out_count, in_count, columns.shape[-1])
        return blocks.permute(2, 3, 1, 4, 0, 5)


def _make_basis(in_rep: Representation, out_rep: Representation, kernel_size: int) -> _Basis | None:
    """Return a basis, stored whole if it is small or the input is not regular, or None if it is empty."""
    if in_rep.kind == "regular":
        waves = rotated_harmonics(in_rep.group, kernel_size)
        if waves.shape[1] * out_rep.size > WHOLE_BASIS_LIMIT:
            return _ColumnBasis(out_rep.matrices, waves * _column_scale(out_rep))
    filters = steerable_basis(in_rep, out_rep, kernel_size)
    return _WholeBasis(filters) if len(filters) else None


@cache
def steerable_basis(in_rep: Representation, out_rep: Representation, kernel_size: int) -> Matrices:
    """Return a basis of the filters K with ``K(g x) = out_rep(g) K(x) in_rep(g)^-1`` for all g of the group.

    Each filter has the energy of one output channel of unit energy for any group.

    :return: (number of filters, out size, in size, kernel_size, kernel_size), read-only
    """
    filters: Matrices
    if in_rep.kind == "regular":
        waves = rotated_harmonics(in_rep.group, kernel_size) * _column_scale(out_rep)
        filters = np.einsum("goq,ghxy->hqogxy", out_rep.matrices, waves)
        filters = filters.reshape(-1, *filters.shape[2:])
    else:
        harmonics, frequencies = harmonic_basis(kernel_size, in_rep.group.n)
        coefficients = _invariant_coefficients(in_rep, out_rep, frequencies)
        filters = np.einsum("phoi,hxy->poixy", coefficients * math.sqrt(out_rep.size), harmonics)
    filters.flags.writeable = False
    return filters


@cache
def rotated_harmonics(group: Group, kernel_size: int) -> Matrices:
    """Return the functions of :func:`harmonic_basis`, rotated by each element without interpolation.

    :return: (elements, number of functions, kernel_size, kernel_size), read-only
    """
    harmonics, frequencies = harmonic_basis(kernel_size, group.n)
    actions = _harmonic_actions(group, frequencies)
    rotated: Matrices = np.einsum("gab,axy->gbxy", actions, harmonics)
    rotated.flags.writeable = False
    return rotated


def _column_scale(out_rep: Representation) -> float:
    """Return the scale of filters that consist of the rotations of one tensor of norm 1."""
    return math.sqrt(out_rep.size / out_rep.group.order)


def _invariant_coefficients(
    in_rep: Representation, out_rep: Representation, frequencies: tuple[int, ...]
) -> Matrices:
    """Return an orthonormal basis (p, h, o, i) of the invariant tensors of (harmonics x out_rep x in_rep)."""
    group = in_rep.group
    harmonic, out = _harmonic_actions(group, frequencies), out_rep.matrices
    # The group permutes the channels of a regular field, so the tensors of its first channel span all.
    if out_rep.kind == "regular":
        spanning: Matrices = np.einsum("gab,gc,gef->bface", harmonic, out[:, :, 0], in_rep.matrices)
        return spanning.reshape(-1, *spanning.shape[2:]) * np.float64(1 / math.sqrt(group.order))
    mean: Matrices = np.einsum("gab,gcd,gef->acebdf", harmonic, out, in_rep.matrices) / group.order
    shape = mean.shape[:3]
    values, vectors = np.linalg.eigh(mean.reshape(math.prod(shape), -1))
    return np.moveaxis(vectors[:, values > PROJECTOR_THRESHOLD].reshape(*shape, -1), -1, 0)


def _harmonic_actions(group: Group, frequencies: tuple[int, ...]) -> Matrices:
    """Return the matrix of each element for the functions of :func:`harmonic_basis`, block diagonal."""
    reps = [group.irrep(frequency) if frequency else group.trivial for frequency in frequencies]
    return np.stack([block_diag(*(rep.matrices[element] for rep in reps)) for element in range(group.order)])


def _invariants(out_type: FieldType) -> th.Tensor:
    """Return the invariant constant feature of each field that can have a bias, (biases, size)."""
    reps = [rep for rep, count in out_type.fields for _ in range(count)]
    fields = np.repeat(np.eye(len(reps)), [rep.size for rep in reps], axis=1)
    return th.tensor(fields[[rep.is_permutation for rep in reps]], dtype=th.float32)
