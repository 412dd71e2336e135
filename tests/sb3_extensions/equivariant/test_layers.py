import copy
import io
import math
import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_extensions.encoders.cnn import count_halvings
from sb3_extensions.encoders.extractors import EquivariantEncoder
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.harmonics import harmonic_basis
from sb3_extensions.equivariant.layers import (
    DynamicEquivariantConv2d,
    EquivariantConv2d,
    EquivariantLinear,
    GroupMaxPool,
    expanded_filters,
)

GROUPS = [Group("cyclic", n) for n in (1, 2, 4, 8)] + [Group("dihedral", n) for n in (1, 2, 4, 8)]
# Of quotient fields: group, order of the subgroup, side of the filter.
QUOTIENTS = [("cyclic", 8, 2, 3), ("cyclic", 32, 2, 1), ("dihedral", 4, 2, 3)]
EXACT = 1e-5


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


def mixed_type(group):
    return FieldType.of(
        (group.regular, 2), (group.irrep(1), 1), (group.sign, 2), (group.trivial, 3), (group.irrep(2), 1)
    )


def grid_elements(group):
    """Elements that map a square grid of pixels to itself."""
    return [g for g in range(group.order) if math.isclose(math.sin(2 * group.angle(g)), 0, abs_tol=1e-9)]


def turn_image(image, group, element):
    """Act on the pixels alone."""
    image = image.flip(-1) if group.reflects(element) else image
    return th.rot90(image, round(group.angle(element) / (math.pi / 2)), (-2, -1))


def act(features, field_type, element):
    """Act on the pixels, if any, and on the channels."""
    matrix = th.tensor(field_type.matrix(element), dtype=features.dtype)
    if features.dim() == 4:
        features = turn_image(features, field_type.group, element)
    return th.einsum("ij,bj...->bi...", matrix, features)


def relative_error(found, expected):
    return float((found - expected).detach().abs().max() / expected.detach().abs().max())


@pytest.mark.parametrize("group", GROUPS, ids=str)
@pytest.mark.parametrize("kernel_size, stride", [(1, 1), (3, 1), (5, 1), (2, 2), (4, 2)])
def test_convolution_commutes_with_the_group(group, kernel_size, stride):
    fields = mixed_type(group)
    layer = EquivariantConv2d(
        fields, fields, kernel_size, stride, padding=kernel_size // 2 - 1 + kernel_size % 2
    )
    nn.init.normal_(layer.bias)
    image = th.randn(2, fields.size, 8, 8)
    out = layer(image)
    assert out.std() > 0.5
    for element in grid_elements(group):
        assert relative_error(layer(act(image, fields, element)), act(out, fields, element)) < EXACT


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_linear_commutes_with_every_element(group):
    fields = mixed_type(group)
    layer = EquivariantLinear(fields, fields)
    nn.init.normal_(layer.bias)
    features = th.randn(3, fields.size)
    for element in range(group.order):
        error = relative_error(layer(act(features, fields, element)), act(layer(features), fields, element))
        assert error < EXACT


@pytest.mark.parametrize("family, n, m, kernel_size", [*QUOTIENTS, ("cyclic", 8, 2, 5)])
def test_quotient_fields_permute(family, n, m, kernel_size):
    group = Group(family, n)
    quotient = FieldType.of((group.quotient(m), 2))
    layer = EquivariantConv2d(FieldType.of((group.regular, 3)), quotient, kernel_size)
    assert layer.bias.numel() == 2
    nn.init.normal_(layer.bias)
    image = th.randn(2, layer.in_type.size, *(2 * [1 if kernel_size == 1 else 7]))
    out = layer(image)
    assert out.std() > 0.5
    for element in range(group.order) if kernel_size == 1 else grid_elements(group):
        turned = layer(act(image, layer.in_type, element))
        assert relative_error(turned, act(out, quotient, element)) < EXACT


def dynamic_layer(family, n, kernel_size, mixed):
    """Return a layer, images and coefficients. Images of one pixel are invariant to all rotations."""
    group = Group(family, n)
    fields = FieldType.of((group.regular, 2), *[(group.irrep(1), 1), (group.quotient(2), 1)] * mixed)
    layer = DynamicEquivariantConv2d(fields, fields, kernel_size, padding=kernel_size // 2)
    image = th.randn(3, fields.size, *(2 * [1 if kernel_size == 1 else 5]))
    return layer, image, th.randn(3, layer.num_coefficients)


DYNAMIC = [("dihedral", 4, 3), ("dihedral", 4, 5), ("cyclic", 4, 3), ("cyclic", 32, 1)]


@pytest.mark.parametrize("family, n, kernel_size", DYNAMIC)
@pytest.mark.parametrize("mixed", [False, True])
def test_dynamic_convolution_commutes_with_the_group(family, n, kernel_size, mixed):
    layer, image, coefficients = dynamic_layer(family, n, kernel_size, mixed)
    group = layer.in_type.group
    out = layer(image, coefficients)
    assert out.shape == image.shape and out.std() > 0.5
    for element in range(group.order) if kernel_size == 1 else grid_elements(group):
        turned = layer(act(image, layer.in_type, element), coefficients)
        assert relative_error(turned, act(out, layer.out_type, element)) < EXACT


@pytest.mark.parametrize("family, n, kernel_size", DYNAMIC)
def test_dynamic_convolution_equals_one_layer_for_each_sample(family, n, kernel_size):
    """Coefficients are the layer's weights in units of the standard deviation that these have at first."""
    layer, image, coefficients = dynamic_layer(family, n, kernel_size, mixed=True)
    own = EquivariantConv2d(layer.in_type, layer.out_type, kernel_size, padding=layer.padding)
    out = layer(image, coefficients)
    for sample in range(len(image)):
        sizes = [*(weight.numel() for weight in own.weights.values()), own.bias.numel()]
        *weights, bias = coefficients[sample].split(sizes)
        with th.no_grad():
            own.bias.copy_(bias)
            for (key, weight), given in zip(own.weights.items(), weights, strict=True):
                weight.copy_(given.view_as(weight) * own.space.std(key, math.sqrt(2)))
        assert relative_error(own(image[[sample]]), out[[sample]]) < EXACT


def test_gradients_reach_coefficients_and_features():
    layer, image, coefficients = dynamic_layer("dihedral", 4, 3, mixed=True)
    layer(image.requires_grad_(), coefficients.requires_grad_()).square().sum().backward()
    for given in (image, coefficients):
        assert th.isfinite(given.grad).all() and (given.grad != 0).flatten(1).any(dim=1).all()
    assert not list(layer.parameters()) and not layer.state_dict()


@pytest.mark.parametrize("batch", [1, 3])
def test_dynamic_convolution_accepts_channels_last_and_bfloat16(batch):
    layer, image, coefficients = dynamic_layer("cyclic", 4, 3, mixed=False)
    image, coefficients = image[:batch], coefficients[:batch]
    expected = layer(image, coefficients)
    assert relative_error(layer(image.to(memory_format=th.channels_last), coefficients), expected) < EXACT
    with th.autocast("cpu", dtype=th.bfloat16):
        assert relative_error(layer(image, coefficients.bfloat16()).float(), expected) < 0.05


def test_dynamic_convolution_rejects_other_shapes_of_coefficients():
    layer, image, coefficients = dynamic_layer("cyclic", 4, 3, mixed=False)
    for wrong in (coefficients[:, 1:], coefficients[0], coefficients[:2]):
        with pytest.raises(ValueError, match=f"coefficients .* {layer.num_coefficients}"):
            layer(image, wrong)


@pytest.mark.parametrize("n", [8, 6])
def test_filters_obey_the_constraint_under_rotations_off_the_grid(n):
    """Continuous filters obey the constraint exactly, because rotated harmonics are exact."""
    group = Group("cyclic", n)
    _, frequencies = harmonic_basis(5, n)
    angle, element = 0.37, 1
    for frequency in frequencies:
        if frequency:
            waves = np.array([np.cos(frequency * angle), np.sin(frequency * angle)])
            turned = frequency * (angle + group.angle(element))
            expected = group.irrep(frequency).matrices[element] @ waves
            np.testing.assert_allclose([np.cos(turned), np.sin(turned)], expected)


def blobs(size, angle, width):
    """Return an image of Gaussian blobs, rotated about its centre without interpolation."""
    axis = th.arange(float(size)) - (size - 1) / 2
    rows, columns = th.meshgrid(axis, axis, indexing="ij")
    places = th.tensor([[0.3, 0.1], [-0.2, 0.25], [0.05, -0.3]]) * size
    turn = th.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    squared = [(rows - x) ** 2 + (columns - y) ** 2 for x, y in places @ turn.T]
    heights = [
        height * th.exp(-each / (2 * width**2)) for height, each in zip((1, -1, 1), squared, strict=True)
    ]
    return th.stack(heights).sum(dim=0)[None, None]


def test_layer_commutes_with_45_degrees_on_smooth_images():
    group = Group("cyclic", 8)
    scalar, regular = FieldType.of((group.trivial, 1)), FieldType.of((group.regular, 4))
    layer = EquivariantConv2d(scalar, regular, 3)
    centre = (slice(None), slice(None), 14, 14)
    plain, turned = (layer(blobs(31, angle, width=5))[centre] for angle in (0, math.pi / 4))
    assert relative_error(turned, act(plain, regular, 1)) < 0.05


@pytest.mark.parametrize("strided", [0, 2])
def test_encoder_commutes_with_45_degrees_up_to_sampling(strided):
    """Pixels and pooling windows do not rotate by 45 degrees, so there is a sampling error."""
    encoder = EquivariantEncoder(1, 64, Group("cyclic", 8), (4, 8, 8, 16, 16), strided=strided)
    with th.no_grad():
        plain, turned = (encoder(blobs(64, angle, width=4)) for angle in (0, math.pi / 4))
    error = (turned - act(plain, encoder.out_type, 1)).norm()
    assert error < 0.4 * turned.norm() and error < (turned - plain).norm()


@pytest.mark.parametrize(
    "group, functions", [(Group("cyclic", 4), 6), (Group("cyclic", 8), 6), (Group("dihedral", 4), 6)]
)
def test_regular_layer_has_a_fraction_of_the_parameters(group, functions):
    fields = FieldType.of((group.regular, 3))
    layer = EquivariantConv2d(fields, fields, 3)
    plain = nn.Conv2d(fields.size, fields.size, 3)
    assert len(harmonic_basis(3, group.n)[0]) == functions
    assert (
        sum(weight.numel() for weight in layer.weights.values())
        == plain.weight.numel() // group.order * functions // 9
    )
    assert layer.bias.numel() == 3


@pytest.mark.parametrize("group", [Group("cyclic", 4), Group("dihedral", 8)], ids=str)
def test_initial_weights_keep_the_scale_of_a_signal(group):
    """By He's rule the mean square doubles, and a ReLU halves it; noise is damped, not amplified."""
    layer = EquivariantConv2d(FieldType.of((group.regular, 64)), FieldType.of((group.regular, 64)), 3)
    constant = th.randn(1, 64, 1, 1, 1).expand(1, 64, group.order, 3, 3).flatten(1, 2)
    out = layer(constant)
    assert out.square().mean().item() == pytest.approx(2 * constant.square().mean().item(), rel=0.5)
    noise = layer(th.randn(1, 64 * group.order, 12, 12))
    assert 0.5 < noise.square().mean() < 2


def test_gradients_reach_every_parameter():
    group = Group("dihedral", 4)
    layer = EquivariantConv2d(mixed_type(group), mixed_type(group), 3)
    layer(th.randn(2, layer.in_type.size, 5, 5)).square().sum().backward()
    for name, parameter in layer.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_group_pooling_is_invariant_and_rejects_other_fields():
    group = Group("cyclic", 8)
    regular = FieldType.of((group.regular, 3))
    pool, features = GroupMaxPool(regular), th.randn(2, 24)
    assert pool(features).shape == (2, 3) and pool.out_type.size == 3
    assert pool(th.randn(2, 24, 5, 5)).shape == (2, 3, 5, 5)
    for element in range(group.order):
        assert th.equal(pool(act(features, regular, element)), pool(features))
    with pytest.raises(ValueError, match="regular fields only"):
        GroupMaxPool(mixed_type(group))


def test_layers_reject_invalid_arguments():
    c4, c8, d4 = Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)
    with pytest.raises(ValueError, match="group"):
        EquivariantLinear(FieldType.of((c4.regular, 1)), FieldType.of((c8.regular, 1)))
    with pytest.raises(ValueError, match="commutes"):
        EquivariantLinear(FieldType.of((d4.trivial, 1)), FieldType.of((d4.sign, 1)))
    with pytest.raises(ValueError, match="kernel_size"):
        EquivariantConv2d(FieldType.of((c4.regular, 1)), FieldType.of((c4.regular, 1)), 0)


def encoder_of(group, size=16, channels=(4, 4, 4), **kwargs):
    return EquivariantEncoder(2, size, group, channels, **kwargs)


@pytest.mark.parametrize("group", [Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)], ids=str)
@pytest.mark.parametrize(
    "size, strided", [(16, 0), (16, 1), (16, 2), (24, 0), (24, 3), (32, 1), (32, 2), (8, 0), (8, 1)]
)
def test_encoder_commutes_with_the_group(group, size, strided):
    channels = (4,) * (count_halvings(size) + 3)
    encoder = encoder_of(group, size, channels, strided=strided)
    image = th.rand(2, 2, size, size)
    features = encoder(image)
    assert features.shape == (2, encoder.features_dim) and features.std() > 0
    for element in grid_elements(group):
        turned = encoder(turn_image(image, group, element))
        assert relative_error(turned, act(features, encoder.out_type, element)) < EXACT


@pytest.mark.filterwarnings("ignore:autocast")
def test_bfloat16_is_close_to_float32():
    exact, rounded = encoder_of(Group("cyclic", 4)), encoder_of(Group("cyclic", 4), autocast="bf16")
    rounded.load_state_dict(exact.state_dict())
    image = th.rand(4, 2, 16, 16)
    out = rounded(image)
    assert out.dtype == th.float32
    assert relative_error(out, exact(image)) < 0.03
    out.sum().backward()
    assert all(p.grad is not None and p.grad.dtype == th.float32 for p in rounded.parameters())


# Filters must follow their weights however these are written: a target network that does not learns nothing.


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("strided", [0, 1])
def test_target_follows_a_polyak_update(training, strided):
    """Stable-Baselines3 sets the target to eval mode once and then writes its weights through ``.data``."""
    online, target = (encoder_of(Group("cyclic", 4), strided=strided) for _ in range(2))
    target.train(training)
    image = th.rand(2, 2, 16, 16)
    with th.no_grad():
        before = target(image)
        polyak_update(online.parameters(), target.parameters(), tau=0.5)
        assert relative_error(target(image), before) > 1e-3
        polyak_update(online.parameters(), target.parameters(), tau=1.0)
        assert th.equal(target(image), online(image))


@pytest.mark.parametrize("training", [True, False])
def test_state_dict_copy_and_pickle(training):
    encoder = encoder_of(Group("dihedral", 4)).train(training)
    keys = set(encoder.state_dict())
    image = th.rand(2, 2, 16, 16)
    expected = encoder(image)
    assert set(encoder.state_dict()) == keys == set(dict(encoder.named_parameters()))
    buffer = io.BytesIO()
    th.save(encoder.state_dict(), buffer)
    buffer.seek(0)
    loaded = encoder_of(Group("dihedral", 4)).train(not training)
    loaded.load_state_dict(th.load(buffer, weights_only=True))
    for other in (copy.deepcopy(encoder), pickle.loads(pickle.dumps(encoder)), loaded):
        assert th.equal(other(image), expected)


def test_expanded_filters_expands_once_and_only_inside_the_context(monkeypatch):
    encoder = encoder_of(Group("cyclic", 4))
    image = th.rand(2, 2, 16, 16)
    layers = [layer for layer in encoder.modules() if isinstance(layer, EquivariantConv2d)]
    expansions = []
    expand = EquivariantConv2d.expand
    monkeypatch.setattr(EquivariantConv2d, "expand", lambda self: expansions.append(self) or expand(self))
    with th.no_grad():
        expected = encoder(image)
        assert len(expansions) == len(layers)
        with expanded_filters(encoder):
            assert all(th.equal(encoder(image), expected) for _ in range(3))
            duplicate = copy.deepcopy(encoder)
        assert len(expansions) == 2 * len(layers)
        for parameter in (*encoder.parameters(), *duplicate.parameters()):
            parameter.data.mul_(0.5)
        assert relative_error(encoder(image), expected) > 1e-3
        assert th.equal(duplicate(image), encoder(image))


def test_expanded_filters_does_not_change_training():
    encoder = encoder_of(Group("cyclic", 4))
    image = th.rand(2, 2, 16, 16)
    with expanded_filters(encoder):
        encoder(image).sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())


def test_expanded_filters_ends_after_an_error():
    encoder = encoder_of(Group("cyclic", 4))
    image = th.rand(2, 2, 16, 16)
    with th.no_grad():
        before = encoder(image)
        with pytest.raises(KeyError), expanded_filters(encoder):
            raise KeyError
        for parameter in encoder.parameters():
            parameter.data.mul_(0.5)
        assert relative_error(encoder(image), before) > 1e-3


def test_expanded_filters_can_be_nested():
    encoder = encoder_of(Group("cyclic", 4))
    layers = [layer for layer in encoder.modules() if isinstance(layer, EquivariantConv2d)]
    with expanded_filters(encoder, encoder):
        outer = layers[0].expanded
        with expanded_filters(encoder):
            assert layers[0].expanded is not outer
        assert layers[0].expanded is outer
    assert all(layer.expanded is None for layer in layers)


@pytest.mark.parametrize("scope", [False, True])
def test_encoder_is_one_graph(scope):
    """The compiler finds no operation that it has to leave to Python."""
    encoder, image = encoder_of(Group("cyclic", 4)), th.rand(2, 2, 16, 16)
    compiled = th.compile(encoder, backend="eager", fullgraph=True)
    with th.no_grad(), expanded_filters(*[encoder] * scope):
        assert relative_error(compiled(image), encoder(image)) < EXACT
