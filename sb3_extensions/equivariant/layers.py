"""Layers that commute with the rotations (and reflections) of a finite group, in plain PyTorch.

The layers are exact under rotations by 90 degrees and reflections. Under other rotations there is a sampling
error, see :mod:`~sb3_extensions.equivariant.harmonics`. Filters are expanded in every forward pass and not
cached, because a Polyak update writes through ``.data``, which a cache cannot detect.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.equivariant.convolution import convolve, full_precision
from sb3_extensions.equivariant.groups import FieldType
from sb3_extensions.equivariant.steerable import FilterSpace

HE_GAIN = math.sqrt(2.0)
"""Gain that keeps the mean square of a signal although a ReLU halves it (He et al., 2015)."""


@contextmanager
def expanded_filters(*modules: nn.Module) -> Iterator[None]:
    """Expand the filters of all layers once, for all forward passes without gradient inside the context.

    The weights must not change inside the context.
    """
    layers = [layer for module in modules for layer in module.modules() if isinstance(layer, SteerableMap)]
    previous = [layer.expanded for layer in layers]
    try:
        with th.no_grad():
            for layer in layers:
                layer.expanded = layer.expand().contiguous(memory_format=th.channels_last)
        yield
    finally:
        for layer, before in zip(reversed(layers), reversed(previous), strict=True):
            layer.expanded = before


class SteerableMap(nn.Module):
    """Base class of the layers: learned linear map between two field types that commutes with the group.

    :param in_type: input fields
    :param out_type: output fields
    :param kernel_size: side of the filter, pixels; 1 for a linear map of vectors
    :param bias: learn a bias for the fields that can have one (regular, quotient, trivial)
    :param gain: gain of the initial weights: ``sqrt(2)`` (He) before a ReLU, 1 without ReLU
    :raises ValueError: if the groups differ or no such map exists
    """

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int = 1,
        bias: bool = True,
        gain: float = HE_GAIN,
    ) -> None:
        super().__init__()
        self.in_type, self.out_type, self.kernel_size = in_type, out_type, kernel_size
        self.space = FilterSpace(in_type, out_type, kernel_size)
        self.weights = nn.ParameterDict()
        for key, shape in self.space.shapes.items():
            self.weights[key] = nn.Parameter(th.empty(shape).normal_(std=self.space.std(key, gain)))
        self.bias = nn.Parameter(th.zeros(self.space.num_biases)) if bias else None
        self.expanded: th.Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "expanded": None}  # the weights of a copy may change

    def expand(self) -> th.Tensor:
        """Return the filter of the equivalent plain convolution, (out channels, in channels, side, side)."""
        return self.space.expand(self.weights)

    def filters(self) -> tuple[th.Tensor, th.Tensor | None]:
        """Return filter and bias in float32, without gradient from an open :func:`expanded_filters`."""
        bias_basis = self.space.bias_basis
        with full_precision(bias_basis.device.type):
            weight = self.expanded
            if weight is None or th.is_grad_enabled():
                weight = self.expand()
            return weight, None if self.bias is None else self.bias @ bias_basis


class EquivariantConv2d(SteerableMap):
    """Convolution of feature maps, (batch, in channels, height, width), that commutes with the group.

    With a stride it is exact under 90 degrees only if the stride divides ``side + 2 padding - kernel_size``.
    See :class:`SteerableMap` for the other parameters.

    :param stride: distance of two outputs, pixels
    :param padding: zeros on each side, pixels
    """

    def __init__(
        self,
        in_type: FieldType,
        out_type: FieldType,
        kernel_size: int = 3,
        stride: int = 1,
        padding: int = 0,
        bias: bool = True,
        gain: float = HE_GAIN,
    ) -> None:
        super().__init__(in_type, out_type, kernel_size, bias, gain)
        self.stride, self.padding = stride, padding

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels, height, width)"""
        weight, bias = self.filters()
        return convolve(features, weight, bias, self.stride, self.padding)


class EquivariantLinear(SteerableMap):
    """Linear map of feature vectors, (batch, in channels), see :class:`SteerableMap` for the parameters."""

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels)"""
        weight, bias = self.filters()
        return F.linear(features, weight.flatten(1), bias)


class DynamicEquivariantConv2d(nn.Module):
    """Convolution that commutes with the group, with a separate filter for each sample of a batch.

    The coefficients of the filters come from another network and must be invariant. Coefficients of variance
    1 make filters of the size of the initial filters of :class:`EquivariantConv2d`. See that class for the
    parameters and errors.
    """

    def __init__(
        self, in_type: FieldType, out_type: FieldType, kernel_size: int = 3, padding: int = 0
    ) -> None:
        super().__init__()
        self.in_type, self.out_type, self.padding = in_type, out_type, padding
        self.space = FilterSpace(in_type, out_type, kernel_size)
        self._sizes = [*map(math.prod, self.space.shapes.values()), self.space.num_biases]
        self.num_coefficients = sum(self._sizes)
        """Number of coefficients of a sample: weights, then one bias for each field that has one."""

    def filters(self, coefficients: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return a filter and a bias for each sample, first axis of length batch."""
        with full_precision(coefficients.device.type):
            *parts, bias = coefficients.float().split(self._sizes, dim=1)
            weights = {
                key: part.unflatten(1, shape) * self.space.std(key, HE_GAIN)
                for part, (key, shape) in zip(parts, self.space.shapes.items(), strict=True)
            }
            return self.space.expand(weights), bias @ self.space.bias_basis

    def forward(self, features: th.Tensor, coefficients: th.Tensor) -> th.Tensor:
        """
        :param coefficients: (batch, num_coefficients)
        :return: (batch, out channels, height, width)
        :raises ValueError: if the coefficients have another shape
        """
        if coefficients.shape != (len(features), self.num_coefficients):
            raise ValueError(
                f"coefficients must have the shape {(len(features), self.num_coefficients)}, "
                f"got {tuple(coefficients.shape)}"
            )
        weight, bias = self.filters(coefficients)
        # One group of a plain convolution for each sample.
        joined = features.reshape(1, -1, *features.shape[2:])
        out: th.Tensor = F.conv2d(
            joined, weight.flatten(0, 1), bias.flatten(), padding=self.padding, groups=len(features)
        )
        return out.view(len(features), -1, *out.shape[2:])


class GroupMaxPool(nn.Module):
    """Maximum of each regular field: (batch, fields x order, ...) to invariant (batch, fields, ...).

    :raises ValueError: if there are other fields
    """

    def __init__(self, in_type: FieldType) -> None:
        super().__init__()
        if any(rep.kind != "regular" for rep, _ in in_type.fields):
            raise ValueError(f"in_type must have regular fields only, got {in_type}")
        self.order = in_type.group.order
        self.out_type = FieldType.of((in_type.group.trivial, in_type.size // self.order))

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, fields, ...)"""
        fields = features.reshape(len(features), -1, self.order, *features.shape[2:])
        return fields.amax(dim=2)
