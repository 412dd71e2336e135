"""Layers that commute with the rotations (and reflections) of a finite group, in plain PyTorch.

A filter is a combination of steerable filters: Gaussian rings times circular harmonics, sampled on the pixel
grid (Weiler and Cesa, "General E(2)-equivariant steerable CNNs", 2019). Under rotations by 90 degrees and
reflections, which map the grid to itself, the layers are exact; under others as exact as a sampled image can
be.

Filters are expanded from their weights in every forward pass, or once in the scope of
:func:`expanded_filters`. They are never kept beyond it: a Polyak update writes through ``.data``, which no
cache can notice.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.networks.groups import FieldType, Group, Matrices, Representation, block_diagonal

# Standard deviation of a ring, in pixels: neighbouring rings overlap without becoming alike.
RING_WIDTH = 0.6
# Smallest eigenvalue taken for 1 when a projector (eigenvalues 0 and 1) is decomposed in float64.
PROJECTOR_THRESHOLD = 0.5

_EXPANDED: ContextVar[Mapping[nn.Module, th.Tensor] | None] = ContextVar("expanded_filters", default=None)


@contextmanager
def expanded_filters(*modules: nn.Module) -> Iterator[None]:
    """Expand the modules' filters once, for every forward pass without gradient inside the scope.

    For several forward passes with the same weights, such as an evaluation or the target network in one
    update. The weights must not change inside the scope. Forward passes with gradient expand as always.

    :param modules: modules whose equivariant layers, at any depth, are expanded
    """
    filters = dict(_EXPANDED.get() or {})
    with th.no_grad():
        for layer in (layer for module in modules for layer in module.modules()):
            if isinstance(layer, SteerableMap):
                filters[layer] = layer.expand()
    token = _EXPANDED.set(filters)
    try:
        yield
    finally:
        _EXPANDED.reset(token)


class SteerableMap(nn.Module):
    """Learned linear map between two field types, of all those that commute with the group.

    :param in_type: input fields
    :param out_type: output fields
    :param kernel_size: side of the filter, pixels; 1 for a map without extent
    :param bias: learn a bias for the fields that may have one (regular and trivial)
    :param gain: of the initialisation: ``sqrt(2)`` (He) before a ReLU, 1 where none follows
    :raises ValueError: if the groups differ or no such map exists
    """

    bias_basis: th.Tensor

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int = 1,
        bias: bool = True,
        gain: float = math.sqrt(2.0),
    ) -> None:
        super().__init__()
        if in_type.group != out_type.group:
            raise ValueError(f"in_type has the group {in_type.group}, out_type {out_type.group}")
        if kernel_size < 1:
            raise ValueError(f"kernel_size must be at least 1, got {kernel_size}")
        self.in_type, self.out_type, self.kernel_size = in_type, out_type, kernel_size
        self.weights = nn.ParameterDict()
        for row, (out_rep, out_count) in enumerate(out_type.fields):
            for column, (in_rep, in_count) in enumerate(in_type.fields):
                basis = th.tensor(steerable_basis(in_rep, out_rep, kernel_size), dtype=th.float32)
                if len(basis):
                    self.register_buffer(f"basis_{row}_{column}", basis, persistent=False)
                    self.weights[f"{row}_{column}"] = nn.Parameter(th.empty(out_count, in_count, len(basis)))
        if not self.weights:
            raise ValueError(f"no map from {in_type} to {out_type} commutes with the group")
        self.register_buffer("bias_basis", _invariants(out_type), persistent=False)
        self.bias = nn.Parameter(th.zeros(len(self.bias_basis))) if bias else None
        self.reset_parameters(gain)

    def reset_parameters(self, gain: float) -> None:
        """Draw normal weights that keep the mean square of a signal, times ``gain ** 2``; biases become zero.

        He's rule for the stronger of two signals: white noise, and what is constant over pixels and fields.
        Steerable filters are smooth and pass the latter, of which images and features behind ReLUs mostly
        consist, better; by the rule for noise alone it would grow with every layer.

        :param gain: see the class
        """
        for key, weight in self.weights.items():
            basis = self.get_buffer(f"basis_{key}")
            noise, constant = basis.square().sum(), basis.sum(dim=(2, 3, 4)).square().sum()
            passed = max(noise.item(), constant.item()) / basis[0].numel()
            nn.init.normal_(weight, std=gain / math.sqrt(self.in_type.size * self.kernel_size**2 * passed))
        if self.bias is not None:
            nn.init.zeros_(self.bias)

    def expand(self) -> th.Tensor:
        """Filter of the plain convolution that does the same: (out channels, in channels, side, side)."""
        rows = [
            [self._expand_block(row, column) for column in range(len(self.in_type.fields))]
            for row in range(len(self.out_type.fields))
        ]
        joined = [blocks[0] if len(blocks) == 1 else th.cat(blocks, dim=1) for blocks in rows]
        return joined[0] if len(joined) == 1 else th.cat(joined, dim=0)

    def _expand_block(self, row: int, column: int) -> th.Tensor:
        """Filters from the fields of one input representation to those of one output representation."""
        (out_rep, out_count), (in_rep, in_count) = self.out_type.fields[row], self.in_type.fields[column]
        shape = (out_count * out_rep.size, in_count * in_rep.size, self.kernel_size, self.kernel_size)
        key = f"{row}_{column}"
        if key not in self.weights:
            return th.zeros(shape, device=self.bias_basis.device)
        # (out fields, in fields, basis) x (basis, out, in, height, width), numbers of a field kept together.
        basis = self.get_buffer(f"basis_{key}")
        blocks = th.matmul(self.weights[key].flatten(0, 1), basis.flatten(1))
        blocks = blocks.view(out_count, in_count, *basis.shape[1:]).transpose(1, 2)
        return blocks.reshape(shape)

    def filters(self) -> tuple[th.Tensor, th.Tensor | None]:
        """Filter and bias in float32, the filter from an open scope if no gradient is wanted."""
        with th.autocast(device_type=self.bias_basis.device.type, enabled=False):
            scope = None if th.is_grad_enabled() else _EXPANDED.get()
            weight = self.expand() if scope is None or self not in scope else scope[self]
            return weight, None if self.bias is None else self.bias @ self.bias_basis


class EquivariantConv2d(SteerableMap):
    """Convolution of a feature map, (batch, in channels, height, width), that commutes with the group.

    With a stride the output is exact under 90 degrees only if it divides ``side + 2 padding - kernel_size``.

    :param stride: pixels between two outputs
    :param padding: zeros added on each side, pixels
    """

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int = 3,
        stride: int = 1,
        padding: int = 0,
        bias: bool = True,
        gain: float = math.sqrt(2.0),
    ) -> None:
        super().__init__(in_type, out_type, kernel_size, bias, gain)
        self.stride, self.padding = stride, padding

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels, height, width)"""
        weight, bias = self.filters()
        return F.conv2d(features, weight, bias, stride=self.stride, padding=self.padding)


class EquivariantLinear(SteerableMap):
    """Map of a feature vector, (batch, in channels), that commutes with the group."""

    def __init__(
        self, in_type: FieldType, out_type: FieldType, bias: bool = True, gain: float = math.sqrt(2.0)
    ) -> None:
        super().__init__(in_type, out_type, 1, bias, gain)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels)"""
        weight, bias = self.filters()
        return F.linear(features, weight.flatten(1), bias)


class GroupMaxPool(nn.Module):
    """Largest number of each regular field: (batch, fields x order, ...) to (batch, fields, ...), invariant.

    :param in_type: regular fields only
    :raises ValueError: if there are others
    """

    def __init__(self, in_type: FieldType) -> None:
        super().__init__()
        if any(rep.kind != "regular" for rep, _ in in_type.fields):
            raise ValueError(f"group pooling needs regular fields only, got {in_type}")
        self.order = in_type.group.order
        self.out_type = FieldType.of((in_type.group.trivial, in_type.size // self.order))

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, fields, ...)"""
        fields = features.reshape(len(features), -1, self.order, *features.shape[2:])
        return fields.amax(dim=2)


@cache
def steerable_basis(in_rep: Representation, out_rep: Representation, kernel_size: int) -> Matrices:
    """Basis of the filters K with ``K(g x) = out_rep(g) K(x) in_rep(g)^-1`` for all g of the group.

    Each has the energy that one output number of unit energy gives, whatever the group: a learning rate then
    means the same for all groups, and about what it means for a plain convolution.

    :param in_rep: representation of an input field
    :param out_rep: representation of an output field
    :param kernel_size: side of the filter, pixels
    :return: (number of filters, out size, in size, kernel_size, kernel_size), read-only
    """
    harmonics, frequencies = harmonic_basis(kernel_size)
    coefficients = _invariant_coefficients(in_rep, out_rep, frequencies)
    filters: Matrices = np.einsum("phoi,hxy->poixy", coefficients * math.sqrt(out_rep.size), harmonics)
    filters.flags.writeable = False
    return filters


@cache
def harmonic_basis(kernel_size: int) -> tuple[Matrices, tuple[int, ...]]:
    """Gaussian rings times circular harmonics on the grid of a filter.

    Rings are one pixel apart. The ring of radius r carries frequencies up to ``floor(r) + 1``: higher ones
    would alias. Of frequencies above 0 there are two, cosine and sine, next to each other.

    :param kernel_size: side of the filter, pixels
    :return: samples (number of functions, kernel_size, kernel_size), each frequency's of unit energy, and
        the frequency of each cosine (or constant), in order
    """
    offsets = np.arange(kernel_size) - (kernel_size - 1) / 2
    rows, columns = np.meshgrid(offsets, offsets, indexing="ij")
    radius, angle = np.hypot(rows, columns), np.arctan2(columns, rows)
    samples, frequencies = [], []
    for ring in np.unique(abs(offsets)):
        profile = np.exp(-0.5 * ((radius - ring) / RING_WIDTH) ** 2)
        for frequency in range(int(ring) + 2 if ring > 0 else 1):
            # The angle of the centre is not defined: only constants may be nonzero there.
            weight = profile if frequency == 0 else np.where(radius > 0, profile, 0.0)
            waves = [np.cos(frequency * angle)] + [np.sin(frequency * angle)] * (frequency > 0)
            pair = np.stack([weight * wave for wave in waves])
            samples.append(pair / math.sqrt((pair**2).sum() / len(pair)))
            frequencies.append(frequency)
    return np.concatenate(samples), tuple(frequencies)


def _invariant_coefficients(
    in_rep: Representation, out_rep: Representation, frequencies: tuple[int, ...]
) -> Matrices:
    """Orthonormal basis (p, h, o, i) of the tensors that (harmonics x out_rep x in_rep) leaves alone."""
    group = in_rep.group
    harmonic = np.stack([_harmonic_action(group, element, frequencies) for element in range(group.order)])
    actions = (harmonic, out_rep.matrices, in_rep.matrices)
    mean: Matrices = np.einsum("gab,gcd,gef->acebdf", *actions) / group.order
    shape = mean.shape[:3]
    # A regular field visits each of its numbers once: the tensors that start at its first number already span
    # all.
    if in_rep.kind == "regular":
        spanning = mean[..., 0].reshape(*shape, -1)
    elif out_rep.kind == "regular":
        spanning = mean[..., 0, :].reshape(*shape, -1)
    else:
        values, vectors = np.linalg.eigh(mean.reshape(math.prod(shape), -1))
        return np.moveaxis(vectors[:, values > PROJECTOR_THRESHOLD].reshape(*shape, -1), -1, 0)
    return np.moveaxis(spanning, -1, 0) * np.float64(math.sqrt(group.order))


def _harmonic_action(group: Group, element: int, frequencies: tuple[int, ...]) -> Matrices:
    """How the harmonics of :func:`harmonic_basis` change under an element: block diagonal."""
    reps = [group.irrep(frequency) if frequency else group.trivial for frequency in frequencies]
    return block_diagonal([rep.matrices[element] for rep in reps])


def _invariants(out_type: FieldType) -> th.Tensor:
    """Constant features that the group leaves alone, one a regular or trivial field: (biases, size)."""
    rows, start = [], 0
    for rep, count in out_type.fields:
        for _ in range(count):
            if rep.is_permutation:
                rows.append(np.zeros(out_type.size))
                rows[-1][start : start + rep.size] = 1.0
            start += rep.size
    return th.tensor(np.array(rows).reshape(len(rows), out_type.size), dtype=th.float32)
