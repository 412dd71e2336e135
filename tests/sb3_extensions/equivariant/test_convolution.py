"""Convolutions that may be matrix products equal PyTorch's."""

from __future__ import annotations

import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.equivariant.convolution import PlainConv2d, convolve


@pytest.mark.parametrize("has_bias", [True, False])
@pytest.mark.parametrize(
    ("side", "kernel_size", "stride", "padding"),
    [(3, 3, 1, 0), (4, 4, 2, 0), (1, 1, 1, 0), (3, 3, 1, 1), (8, 4, 2, 1), (5, 3, 2, 0)],
)
def test_convolutions_and_their_gradients_equal_pytorch(
    side: int, kernel_size: int, stride: int, padding: int, has_bias: bool
) -> None:
    features = th.randn(2, 3, side, side, dtype=th.float64)
    features = features.contiguous(memory_format=th.channels_last).requires_grad_()
    weight = th.randn(5, 3, kernel_size, kernel_size, dtype=th.float64, requires_grad=True)
    bias = th.randn(5, dtype=th.float64, requires_grad=True) if has_bias else None
    given = [features, weight] + ([] if bias is None else [bias])
    ours = convolve(features, weight, bias, stride, padding)
    theirs = F.conv2d(features, weight, bias, stride=stride, padding=padding)
    assert ours.shape == theirs.shape
    assert th.allclose(ours, theirs)
    outputs = th.randn_like(theirs)
    for mine, wanted in zip(
        th.autograd.grad(ours, given, outputs), th.autograd.grad(theirs, given, outputs), strict=True
    ):
        assert th.allclose(mine, wanted)


def test_a_filter_as_large_as_its_image_is_a_matrix_product() -> None:
    features, weight = th.randn(2, 3, 4, 4, requires_grad=True), th.randn(5, 3, 4, 4)
    assert "Convolution" not in str(convolve(features, weight, None).grad_fn)
    wider = convolve(th.randn(2, 3, 5, 4, requires_grad=True), weight, None)
    assert "Convolution" in type(wider.grad_fn).__name__


def test_layer_loads_the_weights_of_pytorch() -> None:
    ours, theirs = PlainConv2d(3, 5, 4, 2, 1), nn.Conv2d(3, 5, 4, 2, 1)
    theirs.load_state_dict(ours.state_dict())
    features = th.randn(2, 3, 8, 8)
    assert th.equal(ours(features), theirs(features))
