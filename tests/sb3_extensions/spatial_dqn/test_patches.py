"""Patches equal the environment's in-hand images, and patches and rotations are equivariant."""

import math

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F

from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.in_hand import rotated_crop
from sb3_extensions.encoders.patch_encoders import LAST_SIDE, LAST_SIDE_OF_PIXELS, PatchVector
from sb3_extensions.spatial_dqn.patches import crop_patches, gather_windows, rotate_images

SIDE = 20
SIZES = (1, 2, 7, 8, 24)
# In the middle, near each border, in corners, and beyond.
ROWS = th.tensor([9, 10, 1, 19, 0, 19, 18, -2])
COLUMNS = th.tensor([11, 0, 17, 7, 0, 19, 1, 5])
ANGLES = th.tensor([0.0, math.pi / 2, 0.3, -2.0, 1.1, 3.0, -0.7, 6.0], dtype=th.float64)


@pytest.mark.parametrize(("size", "side", "side_of_pixels"), [(16, 8, 8), (24, 6, 6), (40, 5, 10)])
def test_maps_before_linear_layers_are_as_large_as_the_authors(
    size: int, side: int, side_of_pixels: int
) -> None:
    for last_side, expected in ((LAST_SIDE, side), (LAST_SIDE_OF_PIXELS, side_of_pixels)):
        network = PatchVector(1, size, [2, 2, 2, 2], [3], last_side)
        linear = next(layer for layer in network if isinstance(layer, th.nn.Linear))
        assert linear.in_features == 2 * expected**2
        assert network(th.zeros(1, 1, size, size)).shape == (1, 3)


@pytest.fixture
def images() -> th.Tensor:
    return 0.4 * th.rand(len(ROWS), 2, SIDE, SIDE, generator=th.Generator().manual_seed(0))


def in_hand_crops(images: th.Tensor, size: int, angles: th.Tensor) -> np.ndarray:
    """Return the environment's in-hand images of a gripper at the centres of the pixels."""
    crops = []
    for channels, row, column, angle in zip(
        images.numpy(), ROWS.tolist(), COLUMNS.tolist(), angles.tolist(), strict=True
    ):
        views = [ElevationMap(image, (0.45, 0.1), 0.4) for image in channels]
        corner, pixel = np.array([0.25, -0.1]), views[0].resolution
        x, y = corner + (np.array([row, column]) + 0.5) * pixel
        crops.append(
            np.concatenate([rotated_crop(view, Pose.planar(x, y, 0.0, angle), size) for view in views])
        )
    return np.stack(crops)


def quarter_turned(images: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Return images rotated by 90 degrees, and the rows and columns of the test pixels in them."""
    return th.rot90(images, k=1, dims=(-2, -1)), SIDE - 1 - COLUMNS, ROWS


@pytest.mark.parametrize("size", SIZES)
def test_patches_are_in_hand_crops(images: th.Tensor, size: int) -> None:
    patches = crop_patches(images, ROWS, COLUMNS, size, ANGLES)
    assert patches.dtype == th.float32
    np.testing.assert_allclose(patches, in_hand_crops(images, size, ANGLES), atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_unrotated_patches_are_in_hand_crops(images: th.Tensor, size: int) -> None:
    patches = crop_patches(images, ROWS, COLUMNS, size)
    np.testing.assert_allclose(patches, in_hand_crops(images, size, th.zeros(len(ROWS))), atol=1e-6)


def test_odd_patches_are_pixels(images: th.Tensor) -> None:
    padded = F.pad(images, [5] * 4)
    patches = crop_patches(images, ROWS, COLUMNS, 7)
    for patch, image, row, column in zip(patches, padded, ROWS.tolist(), COLUMNS.tolist(), strict=True):
        assert th.equal(patch, image[:, row + 2 : row + 9, column + 2 : column + 9])


@pytest.mark.parametrize("size", [7, 8])
@pytest.mark.parametrize("angles", [None, ANGLES], ids=["straight", "turned"])
def test_patches_rotate_with_the_image(images: th.Tensor, size: int, angles: th.Tensor | None) -> None:
    before = crop_patches(images, ROWS, COLUMNS, size, angles)
    after = crop_patches(*quarter_turned(images), size, angles)
    th.testing.assert_close(after, th.rot90(before, k=1, dims=(-2, -1)), atol=1e-7, rtol=0.0)


@pytest.mark.parametrize("size", [7, 8])
def test_patches_do_not_change_when_gripper_and_image_rotate(images: th.Tensor, size: int) -> None:
    before = crop_patches(images, ROWS, COLUMNS, size, ANGLES)
    after = crop_patches(*quarter_turned(images), size, ANGLES + math.pi / 2)
    th.testing.assert_close(after, before, atol=1e-7, rtol=0.0)


def test_images_need_not_be_square(images: th.Tensor) -> None:
    """A patch of a part of the image does not depend on the rest."""
    part = images[:, :, :, :13]
    expected = crop_patches(F.pad(part, [0, 7, 0, 0]), ROWS, COLUMNS, 8, ANGLES)
    th.testing.assert_close(crop_patches(part, ROWS, COLUMNS, 8, ANGLES), expected)


def test_windows_have_a_value_outside_the_image(images: th.Tensor) -> None:
    windows = gather_windows(images, ROWS, COLUMNS, 3, outside=-math.inf)
    padded = F.pad(images, [5] * 4, value=-math.inf)
    for window, image, row, column in zip(windows, padded, ROWS.tolist(), COLUMNS.tolist(), strict=True):
        assert th.equal(window, image[:, row + 2 : row + 9, column + 2 : column + 9])


@pytest.mark.parametrize("side", [8, 9, 128])
@pytest.mark.parametrize("k", [0, 1, 2, 3, -1])
def test_rotations_by_90_degrees_are_rot90(side: int, k: int) -> None:
    images = th.rand(2, 3, side, side, generator=th.Generator().manual_seed(1))
    turned = rotate_images(images, th.full((2,), k * math.pi / 2))
    th.testing.assert_close(turned, th.rot90(images, k=k, dims=(-2, -1)), atol=2e-5, rtol=0.0)


@pytest.mark.parametrize(("side", "size", "border"), [(8, 14, 3), (9, 5, -2)])
def test_rotation_to_another_size_keeps_the_centre(side: int, size: int, border: int) -> None:
    images = th.rand(2, 1, side, side, generator=th.Generator().manual_seed(2))
    turned = rotate_images(images, th.full((2,), math.pi / 2), size)
    expected = F.pad(th.rot90(images, k=1, dims=(-2, -1)), [border] * 4)
    th.testing.assert_close(turned, expected, atol=1e-6, rtol=0.0)


def blobs(places: th.Tensor, size: int) -> th.Tensor:
    """Smooth images, each with one blob at a place (n, 2), pixels from the middle."""
    line = th.arange(size) - (size - 1) / 2
    rows, columns = line[None, :, None] - places[:, :1, None], line[None, None, :] - places[:, 1:, None]
    return th.exp(-(rows**2 + columns**2) / 30)[:, None]


def test_rotation_moves_points_as_vectors() -> None:
    generator = th.Generator().manual_seed(3)
    places = 24 * th.rand(6, 2, generator=generator) - 12
    angles = 12 * th.rand(6, generator=generator) - 6
    (x, y), c, s = places.T, angles.cos(), angles.sin()
    turned = rotate_images(blobs(places, 64), angles, 70)
    expected = blobs(th.stack([c * x - s * y, s * x + c * y], dim=1), 70)
    assert (turned - expected).abs().max() < 0.02
    assert (turned - blobs(places, 70)).abs().max() > 0.5


def test_inverse_rotation_restores_the_image() -> None:
    images, angles = blobs(th.tensor([[9.0, -4.0], [0.0, 7.0]]), 45), th.tensor([0.4, -2.3])
    back = rotate_images(rotate_images(images, angles, 64), -angles, 45)
    assert (back - images).abs().max() < 0.04


def test_rotation_is_zero_outside_the_image() -> None:
    turned = rotate_images(th.ones(1, 1, 10, 10), th.tensor([math.pi / 4]), 16)[0, 0]
    assert th.equal(turned[:2, :2], th.zeros(2, 2)) and turned[7:9, 7:9].min() > 0.999
    # A square rotated by 45 degrees reaches the border with its corners.
    assert turned[1, 7:9].min() > 0.1 and turned[7:9, 1].min() > 0.1
    assert turned.sum() == pytest.approx(100, rel=0.05)


def test_patches_and_rotations_are_differentiable() -> None:
    generator = th.Generator().manual_seed(4)
    images = th.rand(2, 1, 5, 5, generator=generator, dtype=th.float64, requires_grad=True)
    angles, place = th.tensor([0.3, 2.0], dtype=th.float64), th.tensor([1, 3])
    assert th.autograd.gradcheck(lambda values: rotate_images(values, angles, 8), (images,))
    assert th.autograd.gradcheck(lambda values: crop_patches(values, place, place, 4, angles), (images,))
    assert th.autograd.gradcheck(lambda values: crop_patches(values, place, place, 4), (images,))
