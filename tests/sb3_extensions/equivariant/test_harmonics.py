"""Filters of groups with more rotations than the pixel grid: how well one layer commutes with them."""

import math

import numpy as np
import pytest
import torch as th

from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.harmonics import harmonic_basis
from sb3_extensions.equivariant.layers import EquivariantConv2d

SIZES = range(3, 9)
FIELDS = 8
# escnn 1.0.11 with PyTorch 2.13: R2Conv(trivial -> 8 regular fields, bias=False), default initialisation and
# basis, seeds 0 to 2, in place of our layer in layer_error(). One row for each group and width of the blobs
# (pixels), one column for each filter of 3 to 8 pixels.
ESCNN = {
    (8, 5.0): (0.00177, 0.00025, 0.00054, 0.03958, 0.00143, 0.08275),
    (16, 5.0): (0.00145, 0.00020, 0.00044, 0.03232, 0.00117, 0.09598),
    (32, 5.0): (0.00134, 0.00019, 0.00041, 0.02992, 0.00108, 0.08886),
    (8, 2.0): (0.01305, 0.00405, 0.00741, 0.07386, 0.01181, 0.07756),
    (16, 2.0): (0.01068, 0.00332, 0.00606, 0.06036, 0.00968, 0.09265),
    (32, 2.0): (0.00989, 0.00308, 0.00561, 0.05589, 0.00896, 0.08577),
    (8, 1.0): (0.04005, 0.04156, 0.03753, 0.07810, 0.03297, 0.06789),
    (32, 1.0): (0.02980, 0.03134, 0.02882, 0.05963, 0.02531, 0.07857),
}


def blobs(side: int, angle: float, width: float, seed: int, images: int = 16) -> th.Tensor:
    """Random images of four Gaussian blobs, rotated about their centre without interpolation."""
    generator = th.Generator().manual_seed(seed)
    radius, turn = (th.rand(images, 4, generator=generator) for _ in range(2))
    radius, turn = radius.sqrt() * 0.35 * side, turn * 2 * math.pi + angle
    heights = th.randn(images, 4, generator=generator)
    axis = th.arange(side).double() - (side - 1) / 2
    rows, columns = ((radius * wave)[..., None, None] for wave in (turn.cos(), turn.sin()))
    squared = (axis[:, None] - rows) ** 2 + (axis - columns) ** 2
    return (heights[..., None, None] * th.exp(-squared / (2 * width**2))).sum(1)[:, None].float()


def make_layer(n: int, kernel_size: int) -> EquivariantConv2d:
    group = Group("cyclic", n)
    scalar, regular = FieldType.of((group.trivial, 1)), FieldType.of((group.regular, FIELDS))
    return EquivariantConv2d(scalar, regular, kernel_size, bias=False)


@th.no_grad()
def layer_error(n: int, kernel_size: int, width: float) -> float:
    """Relative error at the image's centre, over all rotations that are not multiples of 90 degrees."""
    error = norm = 0.0
    for seed in range(3):
        th.manual_seed(seed)
        layer, side = make_layer(n, kernel_size), 25 if kernel_size % 2 else 26

        def centre(
            angle: float, layer: EquivariantConv2d = layer, side: int = side, seed: int = seed
        ) -> th.Tensor:
            out = layer(blobs(side, angle, width, seed))
            middle = out.shape[-1] // 2
            return out[..., middle, middle].unflatten(1, (FIELDS, n))

        plain = centre(0.0)
        for element in (element for element in range(n) if 4 * element % n):
            turned = centre(2 * math.pi * element / n)
            error += float((turned - plain.roll(element, dims=2)).square().sum())
            norm += float(turned.square().sum())
    return math.sqrt(error / norm)


@pytest.mark.parametrize(("n", "width"), ESCNN)
def test_one_layer_is_at_least_as_exact_as_escnn(n: int, width: float) -> None:
    for size, escnn in zip(SIZES, ESCNN[n, width], strict=True):
        assert layer_error(n, size, width) < escnn, size


@pytest.mark.parametrize("n", [8, 16, 32])
@pytest.mark.parametrize("size", SIZES)
def test_constant_image_has_no_direction(n: int, size: int) -> None:
    layer = make_layer(n, size)
    out = layer(th.ones(1, 1, size, size)).detach().unflatten(1, (FIELDS, n))[..., 0, 0]
    assert out.abs().max() > 0.1
    assert out.std(dim=2).max() < 1e-6


@pytest.mark.parametrize("size", range(1, 10))
def test_harmonics_do_not_respond_to_constants_and_ramps_of_other_frequencies(size: int) -> None:
    samples, frequencies = harmonic_basis(size, 8)
    functions = np.repeat(frequencies, [1 + (frequency > 0) for frequency in frequencies])
    assert len(functions) == len(samples)
    axis = np.arange(size) - (size - 1) / 2
    for image, own in ((np.ones((size, size)), 0), (axis[:, None], 1), (axis[None, :], 1)):
        responses = (samples * image).sum(axis=(1, 2))
        np.testing.assert_allclose(responses[functions != own], 0.0, atol=1e-6)


def test_harmonics_are_independent() -> None:
    for size in SIZES:
        samples, _ = harmonic_basis(size, 8)
        values = np.linalg.svd(samples.reshape(len(samples), -1), compute_uv=False)
        assert values[-1] > 0.25 * values[0]


def test_small_harmonics_are_isotropic_differences() -> None:
    """The gradient of 3 x 3 pixels has weights of 1, 4 and 1, whose error is of fourth order."""
    samples, frequencies = harmonic_basis(3, 8)
    assert frequencies == (0, 0, 1, 2)
    np.testing.assert_allclose(samples[2, 2, 1] / samples[2, 2, 0], 4.0, atol=0.3)
