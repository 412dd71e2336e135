"""Layers and encoders commute with their group, follow their weights, and equal PyTorch's convolutions."""

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

C4, C8, D4 = Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)
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
