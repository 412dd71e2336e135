"""Convolutions that become matrix products for filters of the size of the image, and layers in float32."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch as th
from torch import nn
from torch.nn import functional as F


def convolve(
    features: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, stride: int = 1, padding: int = 0
) -> th.Tensor:
    """
    Convolve feature maps.

    A filter that covers the image is applied as a matrix product, which is two to four times as fast on a
    CPU.

    :param features: (batch, in channels, height, width)
    :param weight: (out channels, in channels, height of the filter, width of the filter)
    :param bias: (out channels,) or None
    :param stride: distance of two outputs, pixels
    :param padding: zeros on each side, pixels
    :return: (batch, out channels, height, width)
    """
    if padding == 0 and weight.shape[2:] == features.shape[2:]:
        return F.linear(features.flatten(1), weight.flatten(1), bias)[..., None, None]
    return F.conv2d(features, weight, bias, stride=stride, padding=padding)


class PlainConv2d(nn.Conv2d):
    """
    PyTorch's convolution, applied by :func:`convolve`.

    :param in_channels: channels of the input
    :param out_channels: channels of the output
    :param kernel_size: side of the filter, pixels
    :param stride: see :func:`convolve`
    :param padding: see :func:`convolve`
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel_size: int, stride: int = 1, padding: int = 0
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size, stride, padding)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, out channels, height, width)"""
        return convolve(features, self.weight, self.bias, int(self.stride[0]), int(self.padding[0]))


def apply_in_float32(layer: nn.Module, features: th.Tensor) -> th.Tensor:
    """
    Apply a layer in float32, also inside an autocast context.

    In bfloat16 the values of several actions are often equal, so the best action would be arbitrary.

    :param layer: layer whose output is compared, such as the last one of a Q network
    :param features: input of the layer, any precision
    """
    with full_precision(features.device.type):
        values: th.Tensor = layer(features.float())
    return values


def full_precision(device_type: str) -> AbstractContextManager[object]:
    """
    Return a context in which autocast is off.

    :param device_type: as in ``torch.device.type``
    """
    return th.autocast(device_type, enabled=False) if th.is_autocast_enabled(device_type) else nullcontext()
