"""What lies in a cube around a gripper, seen along its three axes; for many poses at once, on any device."""

from __future__ import annotations

import math

import torch as th

from sb3_extensions.spatial_dqn.patches import check_places, check_shape, check_size, gather_windows

MAX_VOXELS = 1 << 18
"""Voxels worked on at once, some 30 bytes each: more are no faster on a CPU, whose caches these fit."""
# Places in pixels have 20 binary places. Their sums are exact then, and what lies on the border of two pixels
# falls to the same one in all rows and columns.
FRACTION_BITS = 20
PIXEL = 1 << FRACTION_BITS
HEIGHTMAP_DIMS = 3  # batch, rows, columns
POSES_DIMS = 2  # batch, candidates
TIE = 1e-5
"""How far (pixels) voxels lie off along the gripper's x and y axes. Where a cube of an even size, turned by
quarters, lies around the middle of a pixel, its voxels' middles are on the borders of pixels, and rounding
would draw some to one side and some to the other. Like this a scene that turns keeps its projections."""


def rotation_matrices(theta: th.Tensor, phi: th.Tensor, psi: th.Tensor) -> th.Tensor:
    """
    Rotations about z, then about the turned y, then about the turned x axis: Rz(theta) Ry(phi) Rx(psi).

    :param theta: rad, about z
    :param phi: rad, about y
    :param psi: rad, about x; the shapes of the three are broadcast together
    :return: shape (..., 3, 3), the columns are the turned axes
    """
    angles = th.broadcast_tensors(theta, phi, psi)
    (ct, cf, cs), (st, sf, ss) = (th.stack(angles).cos(), th.stack(angles).sin())
    elements = [
        *(ct * cf, ct * sf * ss - st * cs, ct * sf * cs + st * ss),
        *(st * cf, st * sf * ss + ct * cs, st * sf * cs - ct * ss),
        *(-sf, cf * ss, cf * cs),
    ]
    return th.stack(elements, dim=-1).reshape(*angles[0].shape, 3, 3)


def orthographic_projections(
    heights: th.Tensor,
    rows: th.Tensor,
    columns: th.Tensor,
    z: th.Tensor,
    rotations: th.Tensor,
    size: int,
    resolution: float,
    max_voxels: int = MAX_VOXELS,
) -> th.Tensor:
    """
    How much of a cube around the gripper is full, seen along the gripper's axes, at several poses an image.

    A voxel is full where its middle is under the surface that the heightmap shows at its (nearest) pixel; one
    beyond the heightmap's border is empty. Nothing is passed on to gradients.

    :param heights: m above the floor, shape (batch, rows, columns), floating point
    :param rows: of the pixel in whose middle the gripper is, int64, shape (batch,)
    :param columns: int64, shape (batch,)
    :param z: m, the gripper's height above the floor, shape (batch, candidates)
    :param rotations: columns are the gripper's axes in the world, shape (batch, candidates, 3, 3)
    :param size: voxels a side, each as large as a pixel
    :param resolution: m, side of a pixel
    :param max_voxels: voxels worked on at once, at least those of one pose; the result does not depend on it
    :return: m, float32, shape (batch, candidates, 3, size, size): what is full along the gripper's x, y and z
        axes; rows and columns grow along the other two axes, in their order
    :raises ValueError: if the shapes do not fit, or ``size`` is less than 1
    """
    _check(heights, rows, columns, z, rotations, size)
    with th.no_grad():
        windows = gather_windows(heights[:, None], rows, columns, _reach(size), beyond=-math.inf).flatten(1)
        images = th.arange(len(heights), device=heights.device).repeat_interleave(z.shape[1])
        poses = (images, z.float().flatten(), rotations.float().flatten(0, 1))
        at_once = max(1, max_voxels // size**3)
        counts = [
            _count_full(windows[image], height, rotation, size, resolution)
            for image, height, rotation in zip(*(values.split(at_once) for values in poses), strict=True)
        ]
        return th.cat(counts).mul_(resolution).view(*z.shape, 3, size, size)


def _count_full(
    windows: th.Tensor, z: th.Tensor, rotations: th.Tensor, size: int, resolution: float
) -> th.Tensor:
    """
    How many voxels are full along the axes of each of n grippers.

    :param windows: m, shape (n, side * side), all pixels that a cube may cover, the gripper in the middle
    :param z: m, shape (n,)
    :param rotations: shape (n, 3, 3)
    :return: shape (n, 3, size, size)
    """
    line = th.arange(size, dtype=z.dtype, device=z.device) - (size - 1) / 2.0
    # Where voxels are in the world: (n, the world's axis, the gripper's axis, cell along it), pixels.
    steps = rotations[..., None] * line
    full = _add_axes(steps[:, 2] * resolution, z).flatten(1)
    full.lt_(windows.gather(1, _pixels(steps[:, :2], rotations[:, :2, :2].sum(-1) * TIE)))  # 0 or 1
    cube = full.view(-1, size, size, size)
    return th.stack([cube.sum(dim=axis) for axis in (1, 2, 3)], dim=1)


def _pixels(steps: th.Tensor, shifts: th.Tensor) -> th.Tensor:
    """
    Which pixel of its window each voxel is over.

    :param steps: pixels, shape (n, 2, 3, size)
    :param shifts: of all voxels, pixels, shape (n, 2)
    :return: int64, shape (n, size ** 3)
    """
    side = 2 * _reach(steps.shape[-1]) + 1
    steps, shifts = ((values * PIXEL).round_().to(th.int32) for values in (steps, shifts))
    shifts += side * PIXEL // 2  # from the window's middle to its corner
    rows, columns = (
        _add_axes(steps[:, axis], shifts[:, axis]).bitwise_right_shift_(FRACTION_BITS) for axis in (0, 1)
    )
    return columns.add_(rows, alpha=side).flatten(1).long()


def _add_axes(steps: th.Tensor, start: th.Tensor) -> th.Tensor:
    """
    Add what three axes contribute, for all cells of a cube.

    :param steps: shape (n, 3, size)
    :param start: shape (n,)
    :return: shape (n, size, size, size)
    """
    x, y, z = steps.unbind(1)
    return (x[:, :, None] + (y + start[:, None])[:, None, :])[..., None] + z[:, None, None, :]


def _reach(size: int) -> int:
    """How many pixels on each side a cube covers at most: half its diagonal, rounded."""
    return math.ceil(math.sqrt(3.0) * (size - 1) / 2.0) + 1


def _check(
    heights: th.Tensor, rows: th.Tensor, columns: th.Tensor, z: th.Tensor, rotations: th.Tensor, size: int
) -> None:
    if heights.dim() != HEIGHTMAP_DIMS or not heights.is_floating_point():
        raise ValueError(
            f"heights must be floating point of shape (batch, rows, columns), got {heights.dtype} of shape "
            f"{tuple(heights.shape)}"
        )
    check_places(heights, rows, columns)
    if z.dim() != POSES_DIMS or len(z) != len(heights):
        raise ValueError(f"z must have shape ({len(heights)}, candidates), got {tuple(z.shape)}")
    check_shape("rotations", rotations, (*z.shape, 3, 3))
    check_size(size)
