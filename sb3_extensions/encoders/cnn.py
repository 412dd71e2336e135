"""Convolutional encoders of a square image to a vector. Rotations by 90 degrees are exact."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from itertools import count, pairwise
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.initialisation import initialise_xavier
from sb3_extensions.equivariant.convolution import PlainConv2d

LAST_SIZES = (6, 8)
"""Sides (pixels) at which halving stops. The last two stages reduce these sides to one pixel."""


class Stage(NamedTuple):
    """Convolution, optional max-pooling, ReLU.

    :param kernel_size: side of the filter, pixels
    :param stride: stride of the convolution, pixels
    :param padding: zeros on each side, pixels
    :param pools: whether max-pooling halves the image
    """

    kernel_size: int = 3
    stride: int = 1
    padding: int = 1
    pools: bool = False


POOLED_HALVING = Stage(pools=True)
# 4 pixels is the smallest filter that overlaps its neighbours and keeps the image centre with a stride of 2.
STRIDED_HALVING = Stage(kernel_size=4, stride=2)


def encoded_size(size: int) -> int:
    """Return the side (pixels) to which an encoder resizes an image: the next that halves to 6 or 8."""
    if size < 1:
        raise ValueError(f"image size must be at least 1, got {size}")
    return next(side << k for k in count() for side in LAST_SIZES if side << k >= size)


def count_halvings(size: int) -> int:
    """Return the number of halvings of an image with the side ``size`` until 6 or 8 pixels remain."""
    return (encoded_size(size) // LAST_SIZES[0]).bit_length() - 1


def resize(images: th.Tensor, side: int) -> th.Tensor:
    """Resize square images (batch, channels, size, size) by bilinear interpolation, if the side differs."""
    if images.shape[-1] == side:
        return images
    return F.interpolate(images, size=(side, side), mode="bilinear", align_corners=False)


def plan_stages(size: int, n_stages: int, strided: int | None = None) -> list[Stage]:
    """Return the stages of an encoder: halvings, stages that keep the size, two stages that end in one pixel.

    For 128 pixels, seven stages and ``strided=0``, these are the stages of the paper's encoder.

    :param size: side of the image, pixels
    :param n_stages: number of stages
    :param strided: number of halvings, from the first, that use a stride of 2 instead of pooling; None for
        all. The step from 6 or 8 pixels to 3 counts as the last halving
    :raises ValueError: if ``n_stages`` is too small for the size, or ``strided`` is too large
    """
    halvings = count_halvings(size)
    kept = n_stages - halvings - 2
    if kept < 0:
        raise ValueError(
            f"channels must have at least {halvings + 2} entries for images of size {size}, got {n_stages}"
        )
    strided = halvings + 1 if strided is None else strided
    if not 0 <= strided <= halvings + 1:
        raise ValueError(f"strided must be from 0 to {halvings + 1} for images of size {size}, got {strided}")
    halve = [STRIDED_HALVING] * strided + [POOLED_HALVING] * (halvings + 1 - strided)
    shrink = halve.pop()._replace(padding=0 if encoded_size(size) >> halvings == max(LAST_SIZES) else 1)
    return [*halve, *[Stage()] * kept, shrink, Stage(padding=0)]


def scale_channels(size: int, halving: Sequence[int], last: Sequence[int]) -> tuple[int, ...]:
    """Return the channels of the halving stages, whose last entry may be repeated, and of the last stages."""
    return (*(halving[min(i, len(halving) - 1)] for i in range(count_halvings(size))), *last)


@cache
def has_bf16(device_type: str) -> bool:
    """Return True if a type of device computes in bfloat16."""
    if device_type == "cuda":
        return bool(th.cuda.is_bf16_supported())
    probe = getattr(th.cpu, "_is_avx512_bf16_supported", None)
    return device_type == "cpu" and probe is not None and bool(probe())


def check_autocast(autocast: str | None) -> None:
    """Raise a ValueError if the precision of a network is neither ``"bf16"`` nor None."""
    if autocast not in (None, "bf16"):
        raise ValueError(f"autocast must be None or 'bf16', got {autocast!r}")


def precision(autocast: str | None, device_type: str) -> AbstractContextManager[object]:
    """Return the context for bfloat16 if ``autocast`` is ``"bf16"`` and the device supports it."""
    if autocast is None or not has_bf16(device_type):
        return nullcontext()
    return th.autocast(device_type, dtype=th.bfloat16)


class HalvingMaxPool(nn.Module):
    """Max-pooling of 2 x 2 pixels for even sizes, three times as fast as PyTorch's without gradients."""

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, channels, size / 2, size / 2)"""
        if features.requires_grad and th.is_grad_enabled():
            return F.max_pool2d(features, 2)
        rows = th.maximum(features[..., 0::2, :], features[..., 1::2, :])
        return th.maximum(rows[..., 0::2], rows[..., 1::2])


def stack_stages(
    layer_class: Callable[..., nn.Module], types: Sequence[Any], stages: Sequence[Stage]
) -> nn.Sequential:
    """Return the layers of several stages.

    :param layer_class: class of the convolutions, such as :class:`PlainConv2d`
    :param types: input and output of each convolution in order: channels or field types
    :param stages: stages, one fewer than ``types``
    """
    layers: list[nn.Module] = []
    for (in_type, out_type), stage in zip(pairwise(types), stages, strict=True):
        layers.append(layer_class(in_type, out_type, stage.kernel_size, stage.stride, stage.padding))
        # Pooling before the ReLU gives the same numbers for a quarter of the work.
        layers += [HalvingMaxPool()] if stage.pools else []
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers)


class Encoder(nn.Module):
    """Base class of the encoders: a sequence of stages, (batch, channels, size, size) to (batch, features).

    See :func:`stack_stages` and :func:`plan_stages` for the other parameters.

    :param size: side of the image, pixels; resized if it is not 6 or 8 times a power of two
    :param autocast: ``"bf16"`` for bfloat16 if the device supports it (otherwise float32),
        ``None`` for float32
    :raises ValueError: if size, number of stages and ``strided`` do not match, or ``autocast`` is unknown
    """

    features_dim: int

    def __init__(
        self,
        layer_class: Callable[..., nn.Module],
        types: Sequence[Any],
        size: int,
        strided: int | None = None,
        autocast: str | None = None,
    ) -> None:
        super().__init__()
        check_autocast(autocast)
        self.autocast, self.size = autocast, encoded_size(size)
        self.layers = stack_stages(layer_class, types, plan_stages(size, len(types) - 1, strided))

    def forward(self, image: th.Tensor) -> th.Tensor:
        """:return: float32 features, (batch, features)"""
        device_type = image.device.type
        image = resize(image, self.size)
        with precision(self.autocast, device_type):
            if th.is_autocast_enabled(device_type):
                # Convert before the memory layout changes: there is half as much to move.
                image = image.to(th.get_autocast_dtype(device_type))
            features: th.Tensor = self.layers(image.contiguous(memory_format=th.channels_last))
        return features.flatten(1).float()


class CnnEncoder(Encoder):
    """Plain convolutional encoder with Xavier normal weights and zero biases.

    :param in_channels: channels of the image
    :param size: side of the image, pixels
    :param channels: output channels of each stage; by default the paper's, for the size
    :param kwargs: further parameters of :class:`Encoder`
    """

    # Close-loop CNN baseline of the paper, 128 x 128 pixels.
    HALVING, LAST = (16, 32, 64, 128), (256, 256, 128)

    def __init__(
        self, in_channels: int, size: int, channels: Sequence[int] | None = None, **kwargs: Any
    ) -> None:
        channels = channels or scale_channels(size, self.HALVING, self.LAST)
        super().__init__(PlainConv2d, (in_channels, *channels), size, **kwargs)
        self.apply(initialise_xavier)
        self.features_dim = channels[-1]
