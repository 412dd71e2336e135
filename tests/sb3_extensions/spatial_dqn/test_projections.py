"""Orthographic projections of many poses: equal to the environment's, turning with the scene."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch as th

from bulletarm_gym.geometry import euler_pose, matrix
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.in_hand import projections
from sb3_extensions.spatial_dqn import projections as module
from sb3_extensions.spatial_dqn.projections import orthographic_projections, rotation_matrices

SIDE, RESOLUTION = 20, 0.004  # pixels, m
CANDIDATES = 6
# In the middle, near borders, in a corner.
ROWS, COLUMNS = th.tensor([9, 1, 12, 19]), th.tensor([11, 8, 18, 0])
# Distance to the border of a pixel (pixels) or to a surface (m) below which rounding decides.
MARGIN = 2e-5


@pytest.fixture
def heights() -> th.Tensor:
    return 0.05 * th.rand(len(ROWS), SIDE, SIDE, generator=th.Generator().manual_seed(0))


@pytest.fixture
def poses() -> tuple[th.Tensor, th.Tensor]:
    """Return heights and angles: one pose without rotation, one without tilt, the others random."""
    generator = th.Generator().manual_seed(1)
    z = 0.06 * th.rand(len(ROWS), CANDIDATES, generator=generator)
    angles = 2 * th.rand(3, len(ROWS), CANDIDATES, generator=generator) - 1
    angles[0] *= math.pi
    angles[:, :, 0] = angles[1:, :, 1] = 0.0
    return z, angles


def project(heights: th.Tensor, z: th.Tensor, angles: th.Tensor, size: int, **kwargs: Any) -> th.Tensor:
    rotations = rotation_matrices(*angles)
    return orthographic_projections(heights, ROWS, COLUMNS, z, rotations, size, RESOLUTION, **kwargs)


def slow_cubes(
    image: np.ndarray, row: int, column: int, z: float, rotation: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each voxel is full, and whether rounding may change that."""
    full, doubtful = np.zeros((size,) * 3, bool), np.zeros((size,) * 3, bool)
    for index in itertools.product(range(size), repeat=3):
        offset = rotation @ [k - (size - 1) / 2 for k in index]
        x, y, height = row + 0.5 + offset[0], column + 0.5 + offset[1], z + offset[2] * RESOLUTION
        i, j = math.floor(x), math.floor(y)
        if 0 <= i < SIDE and 0 <= j < SIDE:
            full[index] = height < image[i, j]
            doubtful[index] = abs(height - image[i, j]) < MARGIN * RESOLUTION
        doubtful[index] |= any(abs(place - round(place)) < MARGIN for place in (x, y))
    return full, doubtful


def seen(cubes: np.ndarray) -> np.ndarray:
    return np.stack([cubes.sum(axis=axis) for axis in range(3)])


def flat_poses(heights: th.Tensor, z: th.Tensor, angles: th.Tensor) -> Any:
    """Every image with its place and one of its poses: index, image, row, column, z, (theta, phi, psi)."""
    for b, n in np.ndindex(*z.shape):
        place = ROWS[b].item(), COLUMNS[b].item()
        yield (b, n), heights[b].numpy(), *place, z[b, n].item(), angles[:, b, n].tolist()


@pytest.mark.parametrize("size", [7, 8])
def test_projections_equal_slow_references(heights: th.Tensor, poses: Any, size: int) -> None:
    counts = project(heights, *poses, size) / RESOLUTION
    doubts = []
    for index, image, row, column, z, (theta, phi, psi) in flat_poses(heights, *poses):
        rotation = matrix(euler_pose((0.0, 0.0, 0.0), (psi, phi, theta)))
        full, doubtful = slow_cubes(image, row, column, z, rotation, size)
        differences = np.abs(counts[index].numpy() - seen(full))
        assert (differences < seen(doubtful) + 1e-3).all()
        doubts.append(doubtful.sum())
    n_doubtful = np.reshape(doubts, poses[0].shape)
    assert n_doubtful[:, 1:].max() <= 2, "where the gripper is turned, almost everything is compared"


@pytest.mark.parametrize("size", [8, 9, 24])
def test_projections_equal_the_environments(heights: th.Tensor, poses: Any, size: int) -> None:
    depths = project(heights, *poses, size)
    wrong = []
    for index, image, row, column, z, (theta, phi, psi) in flat_poses(heights, *poses):
        if size % 2 == 0 and theta == phi == psi == 0.0:
            continue  # voxels on the borders of pixels, which the environment rounds arbitrarily
        view = ElevationMap(image, (0.45, 0.0), SIDE * RESOLUTION)
        x, y = np.array(view.centre) + (np.array([row, column]) + 0.5 - SIDE / 2) * RESOLUTION
        expected = projections(view, euler_pose((x, y, z), (psi, phi, theta)), size)
        wrong.append(np.abs(depths[index].numpy() - expected) > RESOLUTION / 2)
    assert expected.any()
    assert np.sum(wrong) <= 3 * 2, "at most two voxels on the border of a pixel"


def test_voxels_on_the_border_of_two_pixels_belong_to_one_side() -> None:
    """Voxels of even cubes that lie between two pixels belong to the further ones."""
    heights, zero = th.full((1, 5, 5), 0.1), th.zeros(1, dtype=th.int64)
    z = th.tensor([[0.05, 0.0951, 0.2]])
    depths = orthographic_projections(heights, zero, zero, z, th.eye(3).expand(1, 3, 3, 3), 4, 0.01)
    inside = np.array([0, 1, 1, 1])
    below = np.array([[1, 1, 1, 1], [1, 1, 0, 0], [0, 0, 0, 0]])  # of z + 0.01 * (-1.5, ..., 1.5)
    for depth, column in zip(depths[0].numpy() / 0.01, below, strict=True):
        side = 3 * np.outer(inside, column)
        top = column.sum() * np.outer(inside, inside)
        np.testing.assert_allclose(depth, [side, side, top], atol=1e-5)


@pytest.mark.parametrize("max_voxels", [1, 1300, 10**7])
def test_chunks_do_not_change_projections(heights: th.Tensor, poses: Any, max_voxels: int) -> None:
    expected = project(heights, *poses, 8)
    assert expected.shape == (len(ROWS), CANDIDATES, 3, 8, 8) and expected.any()
    assert th.equal(project(heights, *poses, 8, max_voxels=max_voxels), expected)


def test_chunks_have_at_most_max_voxels(
    heights: th.Tensor, poses: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunks, count = [], module._count_full
    monkeypatch.setattr(
        module, "_count_full", lambda windows, *rest: chunks.append(len(windows)) or count(windows, *rest)
    )
    project(heights, *poses, 8, max_voxels=5 * 8**3 + 1)
    assert max(chunks) == 5 and sum(chunks) == len(ROWS) * CANDIDATES


@pytest.mark.parametrize("size", [7, 8])
@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.4, 0.0), (0.0, -0.3)])
def test_projections_do_not_change_when_gripper_and_scene_rotate(
    heights: th.Tensor, poses: Any, size: int, k: int, tilt: tuple[float, float]
) -> None:
    """Nothing changes, not even where voxels lie between pixels."""
    z, rows, columns = poses[0], ROWS, COLUMNS
    for _ in range(k):
        rows, columns = SIDE - 1 - columns, rows
    turned = th.rot90(heights, k=k, dims=(1, 2))
    thetas = th.tensor([0.0, k * math.pi / 2])
    before, after = rotation_matrices(thetas, *th.tensor(tilt))[:, None, None].expand(2, *z.shape, 3, 3)
    expected = orthographic_projections(heights, ROWS, COLUMNS, z, before, size, RESOLUTION)
    assert expected.any()
    assert th.equal(orthographic_projections(turned, rows, columns, z, after, size, RESOLUTION), expected)


def test_projections_have_no_gradient(heights: th.Tensor, poses: Any) -> None:
    assert not project(heights.requires_grad_(), *poses, 4).requires_grad


def test_rotation_matrices_equal_the_environments() -> None:
    generator = th.Generator().manual_seed(2)
    theta, phi, psi = (6 * th.rand(5, 3, generator=generator) - 3 for _ in range(3))
    rotations = rotation_matrices(theta, phi, psi)
    for index in np.ndindex(5, 3):
        angles = (psi[index].item(), phi[index].item(), theta[index].item())
        expected = matrix(euler_pose((0.0, 0.0, 0.0), angles))
        np.testing.assert_allclose(rotations[index], expected, atol=1e-6)


def test_rotation_matrices_broadcast() -> None:
    theta, phi, psi = th.rand(4, 1), th.tensor(0.2), th.linspace(-0.4, 0.4, 7)
    rotations = rotation_matrices(theta, phi, psi)
    assert rotations.shape == (4, 7, 3, 3)
    th.testing.assert_close(rotations[2, 5], rotation_matrices(theta[2, 0], phi, psi[5]))
