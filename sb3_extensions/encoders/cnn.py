"""Convolutional encoders of a square image to a vector: the paper's closed-loop CNN, and one of small images.

The paper's encoder and :class:`~sb3_extensions.encoders.equivariant.EquivariantEncoder` halve the image until
6 or 8 pixels a side remain. Two further stages end in one pixel. Every stage maps a grid to one with the same
centre, so rotations by 90 degrees stay exact.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_extensions.equivariant.convolution import PlainConv2d

LAST_SIZES = (6, 8)
"""Sides (pixels) at which halving stops. The last two stages reduce these sides to one pixel."""
AUTOCAST_OPTIONS = (None, "bf16")


class Stage(NamedTuple):
    """A convolution, max-pooling, ReLU.

    :param kernel_size: side of the filter, pixels
    :param stride: of the convolution, pixels
    :param padding: zeros on each side, pixels
    :param pools: whether it halves the image by max-pooling
    """

    kernel_size: int = 3
    stride: int = 1
    padding: int = 1
    pools: bool = False


POOLED_HALVING = Stage(pools=True)
# Four pixels, the smallest filter whose steps of two keep the image's centre and whose neighbours overlap.
STRIDED_HALVING = Stage(kernel_size=4, stride=2)


def encoded_size(size: int) -> int:
    """Return the side to which an encoder resizes an image: the next side that halves to 6 or 8 pixels.

    For example 64 for 64 pixels, 96 for 84, 256 for 224.

    :param size: side of the image, pixels
    :raises ValueError: if the side is not positive
    """
    if size < 1:
        raise ValueError(f"image size must be at least 1, got {size}")
    small, large = LAST_SIZES
    scale = 1
    while large * scale < size:
        scale *= 2
    return small * scale if small * scale >= size else large * scale


def count_halvings(size: int) -> int:
    """Return how often an image is halved until 6 or 8 pixels a side remain.

    :param size: side of the image, pixels. Other sides than 6 or 8 times a power of two are resized first,
        see :func:`encoded_size`
    :raises ValueError: if the side is not positive
    """
    halvings, side = 0, encoded_size(size)
    while side > max(LAST_SIZES):
        halvings, side = halvings + 1, side // 2
    return halvings


def resize(images: th.Tensor, side: int) -> th.Tensor:
    """
    Resize square images by bilinear interpolation, which commutes with rotations by 90 degrees.

    :param images: (batch, channels, size, size)
    :param side: side of the result, pixels
    :return: (batch, channels, side, side), the same tensor if the images have this side
    """
    if images.shape[-1] == side:
        return images
    return F.interpolate(images, size=(side, side), mode="bilinear", align_corners=False)


def plan_stages(size: int, count: int, strided: int = 0) -> list[Stage]:
    """Stages of an encoder: halvings, stages that keep 6 or 8 pixels, two that end in one pixel.

    For 128 pixels and seven stages, none strided, this is the paper's encoder.

    :param size: side of the image, pixels
    :param count: number of stages
    :param strided: halvings, from the first, by a convolution with stride 2 instead of by pooling; the step
        from 6 or 8 pixels to 3 is the last one
    :raises ValueError: if the size cannot be reduced, or in so few stages, or with so many strided
    """
    halvings = count_halvings(size)
    kept = count - halvings - 2
    if kept < 0:
        raise ValueError(
            f"channels needs {halvings + 2} entries or more for images of size {size}, got {count}"
        )
    if not 0 <= strided <= halvings + 1:
        raise ValueError(f"strided must be from 0 to {halvings + 1} for images of size {size}, got {strided}")
    halve = [STRIDED_HALVING] * strided + [POOLED_HALVING] * (halvings + 1 - strided)
    shrink = halve.pop()._replace(padding=0 if encoded_size(size) >> halvings == max(LAST_SIZES) else 1)
    return [*halve, *[Stage()] * kept, shrink, Stage(padding=0)]


def scale_channels(size: int, halving: Sequence[int], last: Sequence[int]) -> tuple[int, ...]:
    """Channels for another image size: as many halvings as it takes, the widest repeated, then the others.

    :param size: side of the image, pixels
    :param halving: channels of the halving stages
    :param last: channels of the stages after them
    """
    return (*(halving[min(i, len(halving) - 1)] for i in range(count_halvings(size))), *last)


@cache
def has_bf16(device_type: str) -> bool:
    """Whether a kind of device computes in bfloat16; if not, one warning says that float32 is used.

    :param device_type: as in ``torch.device.type``
    """
    if device_type == "cuda":
        available = th.cuda.is_bf16_supported()
    else:
        probe = getattr(th.cpu, "_is_avx512_bf16_supported", None)
        available = device_type == "cpu" and probe is not None and probe()
    if not available:
        warnings.warn(f"autocast='bf16': no bfloat16 on this {device_type}, float32 is used", stacklevel=2)
    return bool(available)


def check_autocast(autocast: str | None) -> None:
    """
    Check an argument.

    :param autocast: ``"bf16"`` or None
    :raises ValueError: if it is something else
    """
    if autocast not in AUTOCAST_OPTIONS:
        raise ValueError(f"autocast must be one of {AUTOCAST_OPTIONS}, got {autocast!r}")


def precision(autocast: str | None, device_type: str) -> AbstractContextManager[object]:
    """
    Context in which layers run.

    :param autocast: ``"bf16"`` computes in bfloat16 where the device can; ``None`` in float32
    :param device_type: as in ``torch.device.type``
    """
    if autocast is None or not has_bf16(device_type):
        return nullcontext()
    return th.autocast(device_type, dtype=th.bfloat16)


class HalvingMaxPool(nn.Module):
    """Max-pooling of 2 x 2 pixels: (batch, channels, size, size), its size even, to half the size.

    PyTorch's own also notes which pixel was the largest; where no gradient is wanted, two maxima take a third
    of its time on a CPU.
    """

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: (batch, channels, size / 2, size / 2)"""
        if features.requires_grad and th.is_grad_enabled():
            return F.max_pool2d(features, 2)
        rows = th.maximum(features[..., 0::2, :], features[..., 1::2, :])
        return th.maximum(rows[..., 0::2], rows[..., 1::2])


class Encoder(nn.Module):
    """A sequence of stages: (batch, channels, size, size) to (batch, features).

    :param convolutions: one for each stage
    :param stages: what :func:`plan_stages` gave
    :param size: side of the images that the stages reduce; images of another side are resized
    :param channels_last: keep the channels of a pixel together in memory; faster on CPUs and recent GPUs
    :param autocast: ``"bf16"`` computes in bfloat16 where the device can (with a warning, in float32 where it
        cannot); ``None`` in float32
    :raises ValueError: if ``autocast`` is something else
    """

    def __init__(
        self,
        convolutions: Sequence[nn.Module],
        stages: Sequence[Stage],
        size: int,
        channels_last: bool,
        autocast: str | None,
    ) -> None:
        super().__init__()
        check_autocast(autocast)
        self.autocast, self.size = autocast, size
        self.memory_format = th.channels_last if channels_last else th.contiguous_format
        modules: list[nn.Module] = []
        for convolution, stage in zip(convolutions, stages, strict=True):
            # Pooling before the ReLU gives the same numbers for a quarter of the work.
            pooling = [HalvingMaxPool()] if stage.pools else []
            modules += [convolution, *pooling, nn.ReLU(inplace=True)]
        self.layers = nn.Sequential(*modules)

    def forward(self, image: th.Tensor) -> th.Tensor:
        """:return: float32 features, (batch, features)"""
        device_type = image.device.type
        image = resize(image, self.size)
        with precision(self.autocast, device_type):
            if th.is_autocast_enabled(device_type):
                # Before its layout changes: there is half as much to move
                image = image.to(th.get_autocast_dtype(device_type))
            features: th.Tensor = self.layers(image.contiguous(memory_format=self.memory_format))
        return features.flatten(1).float()


class CnnEncoder(Encoder):
    """Plain convolutional encoder; weights Xavier normal, biases zero.

    :param in_channels: channels of the image
    :param size: side of the image, pixels; resized if it is not 6 or 8 times a power of two
    :param channels: output channels of each stage; those of the paper, for the size, if ``None``
    :param strided: see :func:`plan_stages`
    :param channels_last: see :class:`Encoder`
    :param autocast: see :class:`Encoder`
    :raises ValueError: if size, channels and strided do not fit together
    """

    # Close-loop CNN baseline of the paper, 128 x 128 pixels.
    HALVING, LAST = (16, 32, 64, 128), (256, 256, 128)

    def __init__(
        self,
        in_channels: int,
        size: int,
        channels: Sequence[int] | None = None,
        strided: int = 0,
        channels_last: bool = True,
        autocast: str | None = None,
    ) -> None:
        channels = channels or scale_channels(size, self.HALVING, self.LAST)
        stages = plan_stages(size, len(channels), strided)
        convolutions = [
            PlainConv2d(inputs, outputs, stage.kernel_size, stage.stride, stage.padding)
            for inputs, outputs, stage in zip((in_channels, *channels), channels, stages, strict=False)
        ]
        super().__init__(convolutions, stages, encoded_size(size), channels_last, autocast)
        for convolution in convolutions:
            nn.init.xavier_normal_(convolution.weight)
            nn.init.constant_(convolution.get_parameter("bias"), 0.0)
        self.features_dim = channels[-1]


class SmallImageEncoder(Encoder):
    """Plain convolutional encoder of an image of few pixels, of any size, as of what is in the gripper;
    biases zero.

    Convolutions with stride 2 halve it, the half rounded up, until at most four pixels a side remain; a
    filter as large as these ends it.

    :param in_channels: channels of the image
    :param size: side of the image, pixels
    :param features_dim: number of features
    :param initialise: draws the weights of a layer
    :param channels_last: see :class:`Encoder`
    :param autocast: see :class:`Encoder`
    """

    HALVING = (16, 32, 64)  # channels of the halving stages, the last for all further ones
    LAST_SIZE = 4  # largest side at which halving stops, pixels

    def __init__(
        self,
        in_channels: int,
        size: int,
        features_dim: int,
        initialise: Callable[[th.Tensor], th.Tensor] = nn.init.xavier_normal_,
        channels_last: bool = True,
        autocast: str | None = None,
    ) -> None:
        stages, side = [], size
        while side > self.LAST_SIZE:
            stages.append(Stage(stride=2))
            side = (side + 1) // 2
        stages.append(Stage(kernel_size=side, padding=0))
        halving = [self.HALVING[min(i, len(self.HALVING) - 1)] for i in range(len(stages) - 1)]
        channels = [in_channels, *halving, features_dim]
        convolutions = [
            PlainConv2d(inputs, outputs, stage.kernel_size, stage.stride, stage.padding)
            for (inputs, outputs), stage in zip(pairwise(channels), stages, strict=True)
        ]
        super().__init__(convolutions, stages, size, channels_last, autocast)
        for convolution in convolutions:
            initialise(convolution.weight)
            nn.init.constant_(convolution.get_parameter("bias"), 0.0)
        self.features_dim = features_dim
