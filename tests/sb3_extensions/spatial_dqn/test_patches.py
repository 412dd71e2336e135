"""Patches and projections equal the environment's in-hand images and rotate with the scene."""

import itertools
import math

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F

from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.images import projections, rotated_crop
from sb3_extensions.encoders.patch_encoders import LAST_SIDE, LAST_SIDE_OF_PIXELS, PatchVector
from sb3_extensions.spatial_dqn.patches import crop_patches, rotate_images
from sb3_extensions.spatial_dqn.projections import orthographic_projections, rotation_matrices

SIDE, RESOLUTION = 20, 0.02  # pixels, m
# In the middle, near each border, in corners, and beyond.
ROWS = th.tensor([9, 10, 1, 19, 0, 19, 18, -2])
COLUMNS = th.tensor([11, 0, 17, 7, 0, 19, 1, 5])
ANGLES = th.tensor([0.0, math.pi / 2, 0.3, -2.0, 1.1, 3.0, -0.7, 6.0], dtype=th.float64)


@pytest.mark.parametrize(("size", "side", "side_of_pixels"), [(16, 8, 8), (24, 6, 6), (40, 5, 10)])
def test_maps_before_linear_layers_are_as_large_as_the_authors(size, side, side_of_pixels):
    for last_side, expected in ((LAST_SIDE, side), (LAST_SIDE_OF_PIXELS, side_of_pixels)):
        network = PatchVector(1, size, [2, 2, 2, 2], [3], last_side)
        linear = next(layer for layer in network if isinstance(layer, th.nn.Linear))
        assert linear.in_features == 2 * expected**2
        assert network(th.zeros(1, 1, size, size)).shape == (1, 3)


@pytest.fixture
def images() -> th.Tensor:
    return 0.4 * th.rand(len(ROWS), 2, SIDE, SIDE, generator=th.Generator().manual_seed(0))


def rotated_by_90(images: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Return images rotated by 90 degrees, and the rows and columns of the test pixels in them."""
    return th.rot90(images, k=1, dims=(-2, -1)), SIDE - 1 - COLUMNS, ROWS


@pytest.mark.parametrize("size", [1, 2, 7, 8, 24])
@pytest.mark.parametrize("angles", [None, ANGLES], ids=["straight", "turned"])
def test_patches_are_in_hand_crops_that_rotate_with_the_image(images, size, angles):
    patches = crop_patches(images, ROWS, COLUMNS, size, angles)
    assert patches.dtype == th.float32
    yaws = th.zeros(len(ROWS)) if angles is None else angles
    for k, channel in np.ndindex(len(ROWS), 2):
        view = ElevationMap(images[k, channel].numpy(), (0.45, 0.1), 0.4)
        x, y = np.array([0.25, -0.1]) + (np.array([ROWS[k], COLUMNS[k]]) + 0.5) * RESOLUTION
        [expected] = rotated_crop(view, Pose.planar(x, y, 0.0, yaws[k].item()), size)
        np.testing.assert_allclose(patches[k, channel], expected, atol=1e-6)
    after = crop_patches(*rotated_by_90(images), size, angles)
    th.testing.assert_close(after, th.rot90(patches, k=1, dims=(-2, -1)), atol=1e-7, rtol=0.0)
    after = crop_patches(*rotated_by_90(images), size, yaws + math.pi / 2)
    th.testing.assert_close(after, patches, atol=1e-6, rtol=0.0)
    part = images[:, :, :, :13]  # images need not be square
    expected = crop_patches(F.pad(part, [0, 7, 0, 0]), ROWS, COLUMNS, size, angles)
    th.testing.assert_close(crop_patches(part, ROWS, COLUMNS, size, angles), expected)


def blobs(places: th.Tensor, size: int) -> th.Tensor:
    """Smooth images, each with one blob at a place (n, 2), pixels from the middle."""
    line = th.arange(size) - (size - 1) / 2
    rows, columns = line[None, :, None] - places[:, :1, None], line[None, None, :] - places[:, 1:, None]
    return th.exp(-(rows**2 + columns**2) / 30)[:, None]


def test_rotation_moves_points_as_vectors():
    generator = th.Generator().manual_seed(3)
    places = 24 * th.rand(6, 2, generator=generator) - 12
    angles = 12 * th.rand(6, generator=generator) - 6
    (x, y), c, s = places.T, angles.cos(), angles.sin()
    turned = rotate_images(blobs(places, 64), angles, 70)
    expected = blobs(th.stack([c * x - s * y, s * x + c * y], dim=1), 70)
    assert (turned - expected).abs().max() < 0.02
    assert (turned - blobs(places, 70)).abs().max() > 0.5
    ones = rotate_images(th.ones(1, 1, 10, 10), th.tensor([math.pi / 4]), 16)[0, 0]
    assert th.equal(ones[:2, :2], th.zeros(2, 2)) and ones[7:9, 7:9].min() > 0.999


# Projections of many poses.

FINE = 0.004  # m
CANDIDATES = 6
IMAGE_ROWS, IMAGE_COLUMNS = th.tensor([9, 1, 12, 19]), th.tensor([11, 8, 18, 0])


@pytest.fixture
def heights() -> th.Tensor:
    return 0.05 * th.rand(len(IMAGE_ROWS), SIDE, SIDE, generator=th.Generator().manual_seed(0))


@pytest.fixture
def poses() -> tuple[th.Tensor, th.Tensor]:
    """Return heights and angles: one pose without rotation, one without tilt, the others random."""
    generator = th.Generator().manual_seed(1)
    z = 0.06 * th.rand(len(IMAGE_ROWS), CANDIDATES, generator=generator)
    angles = 2 * th.rand(3, len(IMAGE_ROWS), CANDIDATES, generator=generator) - 1
    angles[0] *= math.pi
    angles[:, :, 0] = angles[1:, :, 1] = 0.0
    return z, angles


def project(heights: th.Tensor, z: th.Tensor, angles: th.Tensor, size: int, **kwargs) -> th.Tensor:
    rotations = rotation_matrices(*angles)
    return orthographic_projections(heights, IMAGE_ROWS, IMAGE_COLUMNS, z, rotations, size, FINE, **kwargs)


@pytest.mark.parametrize("size", [8, 9, 24])
def test_projections_equal_the_environments(heights, poses, size):
    """In chunks of any size and without a gradient."""
    z, angles = poses
    depths = project(heights.requires_grad_(), *poses, size)
    assert not depths.requires_grad
    for max_voxels in (1, 5 * size**3 + 1, 10**7):
        assert th.equal(project(heights, *poses, size, max_voxels=max_voxels), depths)
    wrong = []
    for b, n in np.ndindex(*z.shape):
        theta, phi, psi = angles[:, b, n].tolist()
        if size % 2 == 0 and theta == phi == psi == 0.0:
            continue  # voxels on the borders of pixels, which the environment rounds arbitrarily
        view = ElevationMap(heights[b].detach().numpy(), (0.45, 0.0), SIDE * FINE)
        place = np.array([IMAGE_ROWS[b], IMAGE_COLUMNS[b]]) + 0.5 - SIDE / 2
        pose = euler_pose((*(np.array(view.centre) + place * FINE), z[b, n].item()), (psi, phi, theta))
        expected = projections(view, pose, size)
        wrong.append(np.abs(depths[b, n].numpy() - expected) > FINE / 2)
    assert expected.any()
    assert np.sum(wrong) <= 3 * 2, "at most two voxels on the border of a pixel"


@pytest.mark.parametrize(("size", "k"), list(itertools.product([7, 8], [1, 2, 3])))
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.4, 0.0), (0.0, -0.3)])
def test_projections_do_not_change_when_gripper_and_scene_rotate(heights, poses, size, k, tilt):
    """Nothing changes, not even where voxels lie between pixels."""
    z, rows, columns = poses[0], IMAGE_ROWS, IMAGE_COLUMNS
    for _ in range(k):
        rows, columns = SIDE - 1 - columns, rows
    turned = th.rot90(heights, k=k, dims=(1, 2))
    thetas = th.tensor([0.0, k * math.pi / 2])
    before, after = rotation_matrices(thetas, *th.tensor(tilt))[:, None, None].expand(2, *z.shape, 3, 3)
    expected = orthographic_projections(heights, IMAGE_ROWS, IMAGE_COLUMNS, z, before, size, FINE)
    assert expected.any()
    assert th.equal(orthographic_projections(turned, rows, columns, z, after, size, FINE), expected)
