"""Patches of images around pixels, and images turned in the plane; batched, on any device.

Rows grow with world x, columns with world y. Pixel (i, j) covers [i, i + 1) x [j, j + 1) and has its middle
half a pixel from its borders. A rotation is as in :mod:`sb3_extensions.equivariant.groups`: pi / 2 turns an
image by ``torch.rot90(image, k=1, dims=(-2, -1))``. Everything is linear in the images and passes their
gradients on.
"""

from __future__ import annotations

import math

import torch as th
from torch.nn import functional as F

IMAGE_DIMS = 4  # batch, channels, rows, columns


def crop_patches(
    images: th.Tensor, rows: th.Tensor, columns: th.Tensor, size: int, angles: th.Tensor | None = None
) -> th.Tensor:
    """
    Square patches around the middle of one pixel of each image, turned with a gripper; 0 beyond the border.

    Values between pixels are bilinear. The middle of a patch is the middle of the pixel: where ``size`` is
    even and nothing is turned, each cell is the mean of four pixels.

    :param images: shape (batch, channels, rows, columns), floating point
    :param rows: of the pixels, int64, shape (batch,)
    :param columns: of the pixels, int64, shape (batch,)
    :param size: cells a side, each as large as a pixel
    :param angles: the gripper's yaw, rad, shape (batch,): a patch's rows grow along its x axis, columns along
        its y axis; None: all 0. Needs a device with double precision
    :return: shape (batch, channels, size, size)
    :raises ValueError: if the shapes do not fit, or ``size`` is less than 1
    """
    _check_images(images)
    check_places(images, rows, columns)
    check_size(size)
    if angles is None:
        patches = gather_windows(images, rows, columns, size // 2)
        return patches if size % 2 else F.avg_pool2d(patches, 2, stride=1)
    check_shape("angles", angles, (len(images),))
    # All that a turned patch may cover. Single precision would put cells some 1e-6 pixels off.
    windows = gather_windows(images, rows, columns, math.ceil(math.sqrt(2.0) * (size - 1) / 2.0))
    return rotate_images(windows.double(), -angles, size).to(images.dtype)


def rotate_images(images: th.Tensor, angles: th.Tensor, size: int | None = None) -> th.Tensor:
    """
    Images turned about their middles, bilinearly; 0 beyond the border.

    :param images: shape (batch, channels, side, side), floating point
    :param angles: from x towards y, rad, shape (batch,)
    :param size: pixels a side of the result, which has the same middle; where ``size - side`` is odd, an
        image turned by 0 is half a pixel off and interpolated. None: as many as the images have
    :return: shape (batch, channels, size, size)
    :raises ValueError: if the shapes do not fit, the images are not square, or ``size`` is less than 1
    """
    _check_images(images)
    side = images.shape[-1]
    if images.shape[-2] != side:
        raise ValueError(f"images must be square, got {tuple(images.shape)}")
    check_shape("angles", angles, (len(images),))
    size = side if size is None else size
    check_size(size)
    # What F.affine_grid gives, without its matrix product, which may be rounded to ten bits on a GPU.
    line = (th.arange(size, dtype=images.dtype, device=images.device) - (size - 1) / 2.0) * (2.0 / side)
    turn = angles.to(images)[:, None, None]
    x, y = line[:, None], line[None, :]
    from_rows, from_columns = turn.cos() * x + turn.sin() * y, turn.cos() * y - turn.sin() * x
    grid = th.stack([from_columns, from_rows], dim=-1)
    return F.grid_sample(images, grid, padding_mode="zeros", align_corners=False)


def gather_windows(
    images: th.Tensor, rows: th.Tensor, columns: th.Tensor, reach: int, beyond: float = 0.0
) -> th.Tensor:
    """
    The pixels around one pixel of each image.

    :param images: shape (batch, channels, rows, columns)
    :param rows: of the pixels, int64, shape (batch,)
    :param columns: of the pixels, int64, shape (batch,)
    :param reach: how many pixels on each side, at least 0
    :param beyond: what is beyond the border
    :return: shape (batch, channels, 2 reach + 1, 2 reach + 1)
    """
    offsets = th.arange(-reach, reach + 1, device=images.device)
    down, right = rows[:, None] + offsets, columns[:, None] + offsets
    height, width = images.shape[-2:]
    inside_rows, inside_columns = (down >= 0) & (down < height), (right >= 0) & (right < width)
    inside = inside_rows[:, :, None] & inside_columns[:, None, :]
    down, right = down.clamp(0, height - 1)[:, :, None], right.clamp(0, width - 1)[:, None, :]
    batch = th.arange(len(images), device=images.device)[:, None, None]
    windows = images[batch, :, down, right].movedim(-1, 1)
    return windows.masked_fill(~inside[:, None], beyond)


def check_places(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> None:
    """
    Check that there is one pixel for each image.

    :param images: shape (batch, ...)
    :param rows: of the pixels
    :param columns: of the pixels
    :raises ValueError: if they are not int64 of shape (batch,)
    """
    for name, places in (("rows", rows), ("columns", columns)):
        check_shape(name, places, (len(images),))
        if places.dtype != th.int64:
            raise ValueError(f"{name} must be int64, got {places.dtype}")


def check_shape(name: str, values: th.Tensor, shape: tuple[int, ...]) -> None:
    """
    Check an argument's shape.

    :param name: of the argument
    :param values: its value
    :param shape: what it must have
    :raises ValueError: if it has another
    """
    if values.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(values.shape)}")


def check_size(size: int) -> None:
    """
    Check the side of a result.

    :param size: cells a side
    :raises ValueError: if it is less than 1
    """
    if size < 1:
        raise ValueError(f"size must be at least 1, got {size}")


def _check_images(images: th.Tensor) -> None:
    if images.dim() != IMAGE_DIMS or not images.is_floating_point():
        raise ValueError(
            "images must be floating point of shape (batch, channels, rows, columns), got "
            f"{images.dtype} of shape {tuple(images.shape)}"
        )
