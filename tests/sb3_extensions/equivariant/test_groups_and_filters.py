"""Filters of equivariant layers: rotations off the grid of pixels, and memory."""

import copy
import math

import pytest
import torch as th

from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d, expanded_filters

SIZES = range(3, 9)
FIELDS = 8
# escnn 1.0.11 with PyTorch 2.13: R2Conv(trivial -> 8 regular fields, bias=False), default initialisation and
# basis, seeds 0 to 2, in place of our layer in layer_error(). One row for each group and width of the blobs
# (pixels), one column for each filter of 3 to 8 pixels.
ESCNN = {
    (8, 5.0): (0.00177, 0.00025, 0.00054, 0.03958, 0.00143, 0.08275),
    (8, 2.0): (0.01305, 0.00405, 0.00741, 0.07386, 0.01181, 0.07756),
    (32, 2.0): (0.00989, 0.00308, 0.00561, 0.05589, 0.00896, 0.08577),
    (8, 1.0): (0.04005, 0.04156, 0.03753, 0.07810, 0.03297, 0.06789),
}


def blobs(side, angle, width, seed, images=16):
    """Random images of four Gaussian blobs, rotated about their centre without interpolation."""
    generator = th.Generator().manual_seed(seed)
    radius, turn = (th.rand(images, 4, generator=generator) for _ in range(2))
    radius, turn = radius.sqrt() * 0.35 * side, turn * 2 * math.pi + angle
    heights = th.randn(images, 4, generator=generator)
    axis = th.arange(side).double() - (side - 1) / 2
    rows, columns = ((radius * wave)[..., None, None] for wave in (turn.cos(), turn.sin()))
    squared = (axis[:, None] - rows) ** 2 + (axis - columns) ** 2
    return (heights[..., None, None] * th.exp(-squared / (2 * width**2))).sum(1)[:, None].float()


def make_layer(n, kernel_size):
    group = Group("cyclic", n)
    scalar, regular = FieldType.of((group.trivial, 1)), FieldType.of((group.regular, FIELDS))
    return EquivariantConv2d(scalar, regular, kernel_size, bias=False)


@th.no_grad()
def layer_error(n, kernel_size, width):
    """Relative error at the image's centre, over all rotations that are not multiples of 90 degrees."""
    error = norm = 0.0
    side = 25 if kernel_size % 2 else 26
    middle = slice((side - kernel_size) // 2, (side + kernel_size) // 2)
    for seed in range(3):
        th.manual_seed(seed)
        layer = make_layer(n, kernel_size)
        images = [blobs(side, 2 * math.pi * element / n, width, seed) for element in range(n)]
        with expanded_filters(layer):
            values = [layer(image[..., middle, middle]).unflatten(1, (FIELDS, n)) for image in images]
        for element in (element for element in range(n) if 4 * element % n):
            error += float((values[element] - values[0].roll(element, dims=2)).square().sum())
            norm += float(values[element].square().sum())
    return math.sqrt(error / norm)


@pytest.mark.parametrize(("n", "width"), ESCNN)
def test_one_layer_is_at_least_as_exact_as_escnn(n, width):
    for size, escnn in zip(SIZES, ESCNN[n, width], strict=True):
        assert layer_error(n, size, width) < escnn, size


@pytest.mark.parametrize("n", [8, 16, 32])
@pytest.mark.parametrize("size", SIZES)
def test_constant_image_has_no_direction(n, size):
    layer = make_layer(n, size)
    out = layer(th.ones(1, 1, size, size)).detach().unflatten(1, (FIELDS, n))[..., 0, 0]
    assert out.abs().max() > 0.1
    assert out.std(dim=2).max() < 1e-6


def test_largest_layers_need_little_memory():
    """Buffers and tensors saved for the backward pass do not grow with the basis of 704 filters a field."""
    group = Group("cyclic", 32)
    layer = EquivariantConv2d(FieldType.of((group.regular, 8)), FieldType.of((group.regular, 16)), 7)
    assert max(buffer.numel() for buffer in layer.buffers()) < 40_000  # 160 kB
    # Filters are on the device of the weights: here on that without memory, which mixes with no other
    assert copy.deepcopy(layer).to("meta").expand().device.type == "meta"
    saved = []
    with th.autograd.graph.saved_tensors_hooks(lambda x: saved.append(x.numel()) or x, lambda x: x):
        weight = layer.expand()
    assert weight.shape == (16 * 32, 8 * 32, 7, 7) and sum(saved) < weight.numel()
    # A field's first column may be anything, so its filters are as many as there are harmonics and numbers.
    assert [parameter.shape for parameter in layer.weights.values()] == [(16, 8, 22 * 32)]
