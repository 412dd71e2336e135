"""Orthographic projections of the scene around a gripper along its three axes, for batches of poses."""

import math

import torch as th

from sb3_extensions.spatial_dqn.patches import gather_windows

MAX_VOXELS = 1 << 18
"""Number of voxels (30 bytes each) in one chunk. Larger chunks are not faster on a CPU."""
FRACTION_BITS = 20
"""Binary places of positions in pixels, so that sums are exact."""
ONE_PIXEL = 1 << FRACTION_BITS
"""A pixel as a fixed-point number."""
TIE = 1e-5
"""Shift (pixels) of voxels along the gripper's x and y axes, so that none is on the border of two pixels."""


def rotation_matrices(theta: th.Tensor, phi: th.Tensor, psi: th.Tensor) -> th.Tensor:
    """
    Return intrinsic rotations about z, y and x: Rz(theta) Ry(phi) Rx(psi).

    :return: (..., 3, 3), the columns are the rotated axes
    """
    angles = th.broadcast_tensors(theta, phi, psi)
    (ct, cf, cs), (st, sf, ss) = (th.stack(angles).cos(), th.stack(angles).sin())
    elements = [
        *(ct * cf, ct * sf * ss - st * cs, ct * sf * cs + st * ss),
        *(st * cf, st * sf * ss + ct * cs, st * sf * cs - ct * ss),
        *(-sf, cf * ss, cf * cs),
    ]
    return th.stack(elements, dim=-1).reshape(*angles[0].shape, 3, 3)


@th.no_grad()
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
    Return the full length of a cube around the gripper, along its axes, for several poses an image.

    A voxel is full if its centre is below the height of its pixel. Voxels outside the heightmap are empty.

    :param heights: heightmaps, m, (batch, rows, columns)
    :param rows: row of the pixel below the gripper, int64 (batch,)
    :param columns: column of the pixel, int64 (batch,)
    :param z: height of the gripper, m, (batch, candidates)
    :param rotations: columns are the gripper's axes in the world, (batch, candidates, 3, 3)
    :param size: voxels a side, each as large as a pixel
    :param resolution: side of a pixel, m
    :param max_voxels: voxels in one chunk, at least one pose; has no effect on the result
    :return: full length along the gripper's x, y and z axes, m, float32 (batch, candidates, 3, size, size).
        Rows and columns grow along the other two axes, in order
    """
    windows = gather_windows(heights[:, None], rows, columns, _reach(size), outside=-math.inf).flatten(1)
    images = th.arange(len(heights), device=heights.device).repeat_interleave(z.shape[1])
    poses = (images, z.float().flatten(), rotations.float().flatten(0, 1))
    chunk = max(1, max_voxels // size**3)
    counts = [
        _count_full(windows[image], height, rotation, size, resolution)
        for image, height, rotation in zip(*(values.split(chunk) for values in poses), strict=True)
    ]
    return th.cat(counts).mul_(resolution).view(*z.shape, 3, size, size)


def _count_full(
    windows: th.Tensor, z: th.Tensor, rotations: th.Tensor, size: int, resolution: float
) -> th.Tensor:
    """Return the number of full voxels along the axes of n grippers, (n, 3, size, size)."""
    line = th.arange(size, dtype=z.dtype, device=z.device) - (size - 1) / 2.0
    # World positions of voxels in pixels: (n, axis of the world, axis of the gripper, cell along it).
    steps = rotations[..., None] * line
    full = _add_axes(steps[:, 2] * resolution, z).flatten(1)
    full.lt_(windows.gather(1, _pixels(steps[:, :2], rotations[:, :2, :2].sum(-1) * TIE)))  # 0 or 1
    cube = full.view(-1, size, size, size)
    return th.stack([cube.sum(dim=axis) for axis in (1, 2, 3)], dim=1)


def _pixels(steps: th.Tensor, shifts: th.Tensor) -> th.Tensor:
    """Return the index in its window of the pixel below each voxel, int64 (n, size ** 3)."""
    side = 2 * _reach(steps.shape[-1]) + 1
    steps, shifts = ((values * ONE_PIXEL).round_().to(th.int32) for values in (steps, shifts))
    shifts += side * ONE_PIXEL // 2  # from the centre of the window to its corner
    rows, columns = (
        _add_axes(steps[:, axis], shifts[:, axis]).bitwise_right_shift_(FRACTION_BITS) for axis in (0, 1)
    )
    return columns.add_(rows, alpha=side).flatten(1).long()


def _add_axes(steps: th.Tensor, start: th.Tensor) -> th.Tensor:
    """Add the steps (n, 3, size) along three axes for all cells of a cube, (n, size, size, size)."""
    x, y, z = steps.unbind(1)
    return (x[:, :, None] + (y + start[:, None])[:, None, :])[..., None] + z[:, None, None, :]


def _reach(size: int) -> int:
    """Return the maximum number of pixels on each side that a cube covers: half its diagonal, rounded up."""
    return math.ceil(math.sqrt(3.0) * (size - 1) / 2.0) + 1
