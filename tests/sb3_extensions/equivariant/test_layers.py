"""Layers and encoders commute with their group, also off the grid of pixels, and follow their weights."""

import copy
import io
import itertools
import math
import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.cnn import count_halvings
from sb3_extensions.encoders.extractors import EquivariantEncoder
from sb3_extensions.equivariant.convolution import convolve
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.harmonics import harmonic_basis
from sb3_extensions.equivariant.layers import (
    DynamicEquivariantConv2d,
    EquivariantConv2d,
    EquivariantLinear,
    expanded_filters,
)
from sb3_extensions.equivariant.steerable import steerable_basis

C4, D4 = Group("cyclic", 4), Group("dihedral", 4)
GROUPS = [Group("cyclic", n) for n in (1, 2, 8)] + [Group("dihedral", n) for n in (1, 4)]
EXACT = 1e-5


def mixed_type(group):
    fields = [(group.regular, 2), (group.irrep(1), 1), (group.sign, 2), (group.trivial, 3)]
    return FieldType.of(*fields, (group.irrep(2), 1), (group.quotient(2 - group.n % 2), 1))


def act(features, field_type, element):
    """Act on the pixels, if any, and on the channels."""
    group = field_type.group
    if features.dim() == 4:
        features = features.flip(-1) if group.reflects(element) else features
        features = th.rot90(features, round(group.angle(element) / (math.pi / 2)), (-2, -1))
    return th.einsum("ij,bj...->bi...", th.tensor(field_type.matrix(element), dtype=features.dtype), features)


def relative_error(found, expected):
    return float((found - expected).detach().abs().max() / expected.detach().abs().max())


def convolution(group, kernel_size, stride=1):
    """Return a layer and its input: images of 8 pixels, or of one for filters of one pixel."""
    fields = mixed_type(group)
    layer = EquivariantConv2d(fields, fields, kernel_size, stride, padding=(kernel_size - stride % 2) // 2)
    nn.init.normal_(layer.bias)
    return layer, th.randn(2, fields.size, *[1 if kernel_size == 1 else 8] * 2)


def dynamic_convolution(group, kernel_size):
    fields = mixed_type(group)
    layer = DynamicEquivariantConv2d(fields, fields, kernel_size, padding=kernel_size // 2)
    coefficients = th.randn(2, layer.num_coefficients)
    image = th.randn(2, fields.size, *[1 if kernel_size == 1 else 8] * 2)
    return lambda features: layer(features, coefficients), image


def linear(group):
    fields = mixed_type(group)
    layer = EquivariantLinear(fields, fields)
    nn.init.normal_(layer.bias)
    return layer, th.randn(3, fields.size)


def encoder_of(group, size=16, **kwargs):
    channels = (max(4, 16 // group.order),) * (count_halvings(size) + 3)
    return EquivariantEncoder(2, size, group, channels, **kwargs)


LAYERS = [
    (linear,),
    *[(convolution, *sizes) for sizes in ((1, 1), (3, 1), (5, 1), (2, 2), (4, 2))],
    *[(dynamic_convolution, size) for size in (1, 3, 5)],
]


@pytest.mark.parametrize("group", GROUPS, ids=str)
@pytest.mark.parametrize("make", LAYERS, ids=lambda make: f"{make[0].__name__}{make[1:]}")
def test_layers_commute_with_the_group(make, group):
    """On pixels with those elements that map their grid to itself."""
    layer, features = make[0](group, *make[1:])
    out, fields = layer(features), mixed_type(group)
    assert out.std() > 0
    for element in range(group.order):
        on_grid = math.isclose(math.sin(2 * group.angle(element)), 0, abs_tol=1e-9)
        if on_grid or features.dim() == 2 or features.shape[-1] == 1:
            turned = layer(act(features, fields, element))
            assert relative_error(turned, act(out, fields, element)) < EXACT, element


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_basis_has_the_dimension_of_the_space_of_equivariant_filters(group):
    """The number of trivial representations in the product, from the characters."""
    _, frequencies = harmonic_basis(3, group.n)
    waves = [group.irrep(frequency) if frequency else group.trivial for frequency in frequencies]
    character = sum(np.trace(wave.matrices, axis1=1, axis2=2) for wave in waves)
    for (ours, _), (theirs, _) in itertools.product(mixed_type(group).fields, repeat=2):
        traces = [np.trace(rep.matrices, axis1=1, axis2=2) for rep in (ours, theirs)]
        assert len(steerable_basis(ours, theirs, 3)) == round(np.mean(character * traces[0] * traces[1]))


@pytest.mark.parametrize(("group", "kernel_size"), [(D4, 3), (Group("cyclic", 32), 1)])
def test_dynamic_convolution_equals_one_layer_for_each_sample(group, kernel_size):
    """Coefficients are the layer's weights in units of the standard deviation that these have at first."""
    fields = mixed_type(group)
    layer = DynamicEquivariantConv2d(fields, fields, kernel_size, padding=kernel_size // 2)
    image = th.randn(3, fields.size, *[1 if kernel_size == 1 else 5] * 2, requires_grad=True)
    coefficients = th.randn(3, layer.num_coefficients, requires_grad=True)
    own = EquivariantConv2d(fields, fields, kernel_size, padding=layer.padding)
    out = layer(image, coefficients)
    sizes = [*(weight.numel() for weight in own.weights.values()), own.bias.numel()]
    for sample in range(len(image)):
        *weights, bias = coefficients[sample].split(sizes)
        with th.no_grad():
            own.bias.copy_(bias)
            for (key, weight), given in zip(own.weights.items(), weights, strict=True):
                weight.copy_(given.view_as(weight) * own.space.std(key, math.sqrt(2)))
        assert relative_error(own(image[[sample]]), out[[sample]]) < EXACT
    out.square().sum().backward()
    for given in (image, coefficients):
        assert th.isfinite(given.grad).all() and (given.grad != 0).flatten(1).any(dim=1).all()
    assert not list(layer.parameters()) and not layer.state_dict()
    for wrong in (coefficients[:, 1:], coefficients[0], coefficients[:2]):
        with pytest.raises(ValueError, match=f"coefficients .* {layer.num_coefficients}"):
            layer(image, wrong)


def test_initial_weights_keep_the_scale_of_a_signal_and_get_gradients():
    """By He's rule the mean square doubles, and a ReLU halves it; noise is damped, not amplified."""
    for group in (C4, Group("dihedral", 8)):
        layer = EquivariantConv2d(FieldType.of((group.regular, 64)), FieldType.of((group.regular, 64)), 3)
        constant = th.randn(1, 64, 1, 1, 1).expand(1, 64, group.order, 3, 3).flatten(1, 2)
        out = layer(constant)
        assert out.square().mean().item() == pytest.approx(2 * constant.square().mean().item(), rel=0.5)
        assert 0.5 < layer(th.randn(1, 64 * group.order, 12, 12)).square().mean() < 2
    mixed = EquivariantConv2d(mixed_type(D4), mixed_type(D4), 3)
    mixed(th.randn(2, mixed.in_type.size, 5, 5)).square().sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in mixed.parameters())


def test_bfloat16_is_close_to_float32():
    exact, rounded = encoder_of(C4), encoder_of(C4, autocast="bf16")
    rounded.load_state_dict(exact.state_dict())
    image = th.rand(4, 2, 16, 16)
    out = rounded(image)
    assert out.dtype == th.float32
    assert relative_error(out, exact(image)) < 0.03
    out.sum().backward()
    assert all(p.grad is not None and p.grad.dtype == th.float32 for p in rounded.parameters())


# Filters must follow their weights however these are written: a target network that does not learns nothing.


@pytest.mark.parametrize("training", [True, False])
def test_filters_follow_the_weights(training):
    """Stable-Baselines3 sets the target to eval mode once and then writes its weights through ``.data``."""
    online, target, loaded = (encoder_of(D4, strided=1).train(training) for _ in range(3))
    image = th.rand(2, 2, 16, 16)
    with th.no_grad():
        before, expected = target(image), online(image)
        polyak_update(online.parameters(), target.parameters(), tau=0.5)
        assert relative_error(target(image), before) > 1e-3
        polyak_update(online.parameters(), target.parameters(), tau=1.0)
    buffer = io.BytesIO()
    th.save(online.state_dict(), buffer)
    buffer.seek(0)
    loaded.load_state_dict(th.load(buffer, weights_only=True))
    for other in (target, loaded, copy.deepcopy(online), pickle.loads(pickle.dumps(online))):
        assert th.equal(other(image), expected)


@pytest.mark.parametrize("scope", [False, True])
def test_encoder_is_one_graph(scope):
    """The compiler finds no operation that it has to leave to Python."""
    network, image = encoder_of(C4), th.rand(2, 2, 16, 16)
    compiled = th.compile(network, backend="eager", fullgraph=True)
    with th.no_grad(), expanded_filters(*[network] * scope):
        assert relative_error(compiled(image), network(image)) < EXACT


@pytest.mark.parametrize(
    ("side", "kernel_size", "stride", "padding", "has_bias"),
    [(3, 3, 1, 0, True), (4, 4, 2, 0, False), (1, 1, 1, 0, True), (8, 4, 2, 1, False), (5, 3, 2, 0, True)],
)
def test_convolutions_and_their_gradients_equal_pytorch(side, kernel_size, stride, padding, has_bias):
    features = th.randn(2, 3, side, side, dtype=th.float64)
    features = features.contiguous(memory_format=th.channels_last).requires_grad_()
    weight = th.randn(5, 3, kernel_size, kernel_size, dtype=th.float64, requires_grad=True)
    bias = th.randn(5, dtype=th.float64, requires_grad=True) if has_bias else None
    given = [features, weight] + ([] if bias is None else [bias])
    ours = convolve(features, weight, bias, stride, padding)
    theirs = F.conv2d(features, weight, bias, stride=stride, padding=padding)
    th.testing.assert_close(ours, theirs)
    outputs = th.randn_like(theirs)
    th.testing.assert_close(*(th.autograd.grad(each, given, outputs) for each in (ours, theirs)))
    as_large_as_the_image = side == kernel_size and padding == 0
    assert ("Convolution" not in type(ours.grad_fn).__name__) == as_large_as_the_image


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
