"""Patches of images around pixels, and images rotated as in :mod:`sb3_extensions.equivariant.groups`."""

import math

import torch as th
from torch.nn import functional as F


def crop_patches(
    images: th.Tensor, rows: th.Tensor, columns: th.Tensor, size: int, angles: th.Tensor | None = None
) -> th.Tensor:
    """
    Crop a square patch around the centre of one pixel of each image, with zeros outside the image.

    Interpolation is bilinear.

    :param images: (batch, channels, rows, columns), floating point
    :param rows: row of each pixel, int64 (batch,)
    :param columns: column of each pixel, int64 (batch,)
    :param size: cells a side, each as large as a pixel
    :param angles: yaw of the gripper, rad, (batch,); None for 0. Needs a device with double precision
    :return: (batch, channels, size, size)
    """
    if angles is None:
        patches = gather_windows(images, rows, columns, size // 2)
        return patches if size % 2 else F.avg_pool2d(patches, 2, stride=1)
    # Windows of half the diagonal contain the rotated patch. In single precision cells would be some 1e-6
    # pixels off.
    windows = gather_windows(images, rows, columns, math.ceil(math.sqrt(2.0) * (size - 1) / 2.0))
    return rotate_zero_padded(windows.double(), -angles, size).to(images.dtype)


def rotate_zero_padded(images: th.Tensor, angles: th.Tensor, size: int | None = None) -> th.Tensor:
    """
    Rotate images about their centres by bilinear interpolation, with zeros outside the image.

    :param images: (batch, channels, side, side), floating point
    :param angles: from x towards y, rad, (batch,)
    :param size: side of the result with the same centre, pixels, by default that of the images
    :return: (batch, channels, size, size)
    """
    side = images.shape[-1]
    size = side if size is None else size
    # As F.affine_grid without its matrix product, which a GPU may round to ten bits.
    line = (th.arange(size, dtype=images.dtype, device=images.device) - (size - 1) / 2.0) * (2.0 / side)
    angle = angles.to(images)[:, None, None]
    x, y = line[:, None], line[None, :]
    from_rows, from_columns = angle.cos() * x + angle.sin() * y, angle.cos() * y - angle.sin() * x
    grid = th.stack([from_columns, from_rows], dim=-1)
    return F.grid_sample(images, grid, padding_mode="zeros", align_corners=False)


def gather_windows(
    images: th.Tensor, rows: th.Tensor, columns: th.Tensor, reach: int, outside: float = 0.0
) -> th.Tensor:
    """
    Return the pixels around one pixel of each image.

    See :func:`crop_patches` for the other parameters.

    :param reach: number of pixels on each side
    :param outside: value outside the image
    :return: (batch, channels, 2 reach + 1, 2 reach + 1)
    """
    offsets = th.arange(-reach, reach + 1, device=images.device)
    down, right = rows[:, None] + offsets, columns[:, None] + offsets
    height, width = images.shape[-2:]
    inside_rows, inside_columns = (down >= 0) & (down < height), (right >= 0) & (right < width)
    inside = inside_rows[:, :, None] & inside_columns[:, None, :]
    down, right = down.clamp(0, height - 1)[:, :, None], right.clamp(0, width - 1)[:, None, :]
    batch = th.arange(len(images), device=images.device)[:, None, None]
    windows = images[batch, :, down, right].movedim(-1, 1)
    return windows.masked_fill(~inside[:, None], outside)
